// SPDX-License-Identifier: Apache-2.0
/** Intervals of retries after failures, and of requests for growing files. */

/** Intervals in seconds. */
export interface RetryPolicy {
  /** After a broken connection; after the last one the request fails. */
  readonly retries: readonly number[];
  /** For a growing file: the first interval, the longest, and the factor between consecutive ones. */
  readonly firstPoll: number;
  readonly longestPoll: number;
  readonly backOff: number;
  /** A file that has not grown for this time counts as finished. */
  readonly stillAfter: number;
}

export const RETRY_POLICY: RetryPolicy = {
  retries: [0.5, 1, 2, 4, 8],
  firstPoll: 0.5,
  longestPoll: 10,
  backOff: 1.4,
  stillAfter: 1800,
};
