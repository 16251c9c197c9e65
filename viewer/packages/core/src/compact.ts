// SPDX-License-Identifier: Apache-2.0
/** The compact codec: quantization indices, predicted from the frame before and entropy coded (docs/bitstream.md). */

import { AdaptiveDecoder } from "./adaptive.js";
import {
  CODABLE,
  decodedScene,
  dequantizeState,
  FREE_STEPS,
  quantizeState,
  type SceneBins,
  withoutChange,
} from "./bins.js";
import { Models } from "./decisions.js";
import { StreamError } from "./errors.js";
import { type FieldName, mergedFields, type Tensor } from "./fields.js";
import type { StreamHeader } from "./header.js";

/** The decoder's state after a packet. */
interface CompactState {
  readonly index: number;
  readonly bins: SceneBins;
  readonly models: Models;
}

/**
 * Checks that packets with this header can be decoded.
 *
 * @throws StreamError dynamic fields that cannot be coded, or no step or reference for one
 */
export function checkCodec(header: StreamHeader): void {
  const { codec, dynamic, steps, reference } = header;
  if (codec === "raw") {
    if (reference.size)
      throw new StreamError("The init record holds dynamic fields, which codec 'raw' has no use for.");
    return;
  }
  const beyond = [...dynamic].filter((name) => !CODABLE.has(name));
  if (beyond.length) throw new StreamError(`The compact codec has no coding for ${beyond.join(", ")}.`);
  if (dynamic.has("free") !== dynamic.has("free_births")) {
    throw new StreamError("The header announces free Gaussians without their births, or births without them.");
  }
  const rows = referenceNames(dynamic);
  const needed: readonly string[] = dynamic.has("free") ? [...rows, ...FREE_STEPS] : rows;
  const missing = needed.filter((name) => !steps.has(name));
  if (missing.length) throw new StreamError(`The header states no step for ${missing.join(", ")}.`);
  if (reference.size !== rows.length || !rows.every((name) => reference.has(name))) {
    throw new StreamError("The header's reference state does not hold the dynamic fields of anchors and MLPs.");
  }
}

function referenceNames(dynamic: ReadonlySet<FieldName>): FieldName[] {
  return [...dynamic].filter((name) => name !== "free" && name !== "free_births");
}

/** Decodes the frames of one stream in order from any key packet. A packet that throws does not change the state. */
export class CompactDecoder {
  private readonly reference: SceneBins;
  private state: CompactState | undefined;

  /** @throws StreamError the reference has a value that no index represents */
  constructor(private readonly header: StreamHeader) {
    const known = mergedFields(header.static, header.reference);
    this.reference = quantizeState(known, new Set(referenceNames(header.dynamic)), header.steps);
  }

  /**
   * Decodes a packet; {@link values} then returns its frame.
   *
   * @throws StreamError the packet is damaged, or does not follow the last one
   */
  advance(fields: ReadonlyMap<FieldName, Uint8Array>, isKey: boolean, index: number): void {
    const { dynamic } = this.header;
    const where = `Packet ${index}`;
    const start = isKey ? { bins: this.reference, models: undefined } : this.state;
    if (start === undefined || (!isKey && this.state?.index !== index - 1)) {
      throw new StreamError(`${where} needs packet ${index - 1}, which was not decoded before it.`);
    }
    const models = new Models(start.models);
    const decoder = new AdaptiveDecoder(models, fields, where);
    const bins = decodedScene(decoder, start.bins, dynamic, where);
    decoder.end();
    // A key packet has all changes since the reference, which do not predict the next frame's.
    this.state = { index, bins: isKey ? withoutChange(bins) : bins, models };
  }

  /** The dynamic fields of the last packet's frame; {@link advance} must have been called. */
  values(): Map<FieldName, Tensor> {
    return dequantizeState(this.state!.bins, this.header.dynamic, this.header.steps);
  }
}
