// SPDX-License-Identifier: Apache-2.0

/** The renderer does not support a device or a call; the message is one sentence for the user. */
export class GlError extends Error {
  override readonly name = "GlError";
}
