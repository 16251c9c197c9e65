// SPDX-License-Identifier: Apache-2.0
/** Waits of requests that fail, and of files that grow. */

/** Waits in seconds. */
export interface RetryPolicy {
  /** After a connection broke; when all are used up, it failed. */
  readonly retries: readonly number[];
  /** For new bytes of a growing file: the first wait, the longest, and by how much each is longer than the last. */
  readonly firstPoll: number;
  readonly longestPoll: number;
  readonly backOff: number;
  /** A file that has not grown for so long is given up. */
  readonly stillAfter: number;
}

export const RETRY_POLICY: RetryPolicy = {
  retries: [0.5, 1, 2, 4, 8],
  firstPoll: 0.5,
  longestPoll: 10,
  backOff: 1.4,
  stillAfter: 1800,
};
