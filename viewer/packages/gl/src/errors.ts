// SPDX-License-Identifier: Apache-2.0

/** A device or a call that the renderer cannot serve: one sentence for the user. */
export class GlError extends Error {
  override readonly name = "GlError";
}
