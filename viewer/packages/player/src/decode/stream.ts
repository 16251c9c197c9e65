// SPDX-License-Identifier: Apache-2.0
/** A stream that is being decoded: what there is of it, and what its frames belong to. */

import { SceneDecoder, type StreamHeader } from "@structgstream/core";
import type { Catalog } from "./catalog.js";
import { ChangedFields } from "./changedFields.js";
import type { PacketLoader } from "./packetLoader.js";
import type { PacketStore } from "./packetStore.js";

/** What one init record begins. */
export class Chapter {
  readonly decoder: SceneDecoder;
  readonly changed: ChangedFields;

  constructor(readonly header: StreamHeader) {
    this.decoder = new SceneDecoder(header);
    this.changed = new ChangedFields(header.dynamic);
  }
}

export interface Stream {
  readonly catalog: Catalog;
  readonly store: PacketStore;
  readonly loader: PacketLoader;
  /**
   * What a frame belongs to; undefined while what is needed to know that, or its init record, is being fetched.
   *
   * @param ahead the frame after the last that will be wanted soon
   */
  chapter(index: number, ahead: number): Chapter | undefined;
}
