// SPDX-License-Identifier: Apache-2.0
/** What an engine may be told. */

export interface EngineOptions {
  /** Packets are kept in no more bytes than these. */
  readonly budgetBytes?: number;
  /** While playing, packets are fetched for so many seconds ahead. */
  readonly aheadSeconds?: number;
}
