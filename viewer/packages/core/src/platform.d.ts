// SPDX-License-Identifier: Apache-2.0
// What browsers, workers and Node have in common beyond the language itself; the package uses nothing else.

declare class TextDecoder {
  constructor(label: string, options: { fatal: boolean; ignoreBOM: boolean });
  decode(bytes: Uint8Array): string;
}
