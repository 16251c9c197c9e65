// SPDX-License-Identifier: Apache-2.0
/** Options of an engine. */

export interface EngineOptions {
  /** Largest number of bytes of stored packets. */
  readonly budgetBytes?: number;
  /** Seconds for which packets are fetched in advance during playback. */
  readonly aheadSeconds?: number;
}
