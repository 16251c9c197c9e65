// SPDX-License-Identifier: Apache-2.0
/** What tests ask of an example of a package, in its page. */

import type { Fields, Playback } from "@structgstream/core";
import { glCounts } from "./glCounts.js";

interface Clip {
  readonly playback: Playback;
  show(fields: Fields): void;
}

export interface ExampleStage {
  /** Frames of all streams that were shown. */
  readonly shown: number;
  readonly clips: readonly Clip[];
  readonly glCounts: typeof glCounts;
  readonly removeStreams: () => void;
}

export function exposed(clips: readonly Clip[], removeStreams: () => void): ExampleStage {
  const stage = { shown: 0, clips, glCounts, removeStreams };
  for (const clip of clips) {
    const show = clip.show.bind(clip);
    clip.show = (fields) => {
      stage.shown++;
      show(fields);
    };
  }
  return stage;
}
