// SPDX-License-Identifier: Apache-2.0
// The common part of the platforms of browsers, workers and Node; the package uses nothing else.

declare class TextDecoder {
  constructor(label: string, options: { fatal: boolean; ignoreBOM: boolean });
  decode(bytes: Uint8Array): string;
}
