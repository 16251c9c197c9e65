// SPDX-License-Identifier: Apache-2.0
/** Options of an engine. */

import type { Sound } from "../sound/sound.js";

export interface EngineOptions {
  /** Largest number of bytes of stored packets. */
  readonly budgetBytes?: number;
  /** Seconds for which packets are fetched in advance during playback. */
  readonly aheadSeconds?: number;
  /** Plays the sound; its clock is the engine's. */
  readonly sound?: Sound;
}
