// SPDX-License-Identifier: Apache-2.0
/** How long readings wait for what is not there. */

/** How long is waited before looking again, in seconds. */
export interface Patience {
  /** After a connection broke; when all are used up, it failed. */
  readonly retries: readonly number[];
  /** For new bytes of a growing file: the first wait, the longest, and by how much each is longer than the last. */
  readonly firstPoll: number;
  readonly longestPoll: number;
  readonly backOff: number;
  /** A file that has not grown for so long is given up. */
  readonly stillAfter: number;
}

export const PATIENCE: Patience = {
  retries: [0.5, 1, 2, 4, 8],
  firstPoll: 0.5,
  longestPoll: 10,
  backOff: 1.4,
  stillAfter: 1800,
};
