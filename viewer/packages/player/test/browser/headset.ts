// SPDX-License-Identifier: Apache-2.0
/** A headset that iwer, the Immersive Web Emulation Runtime, emulates in a page. */

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import type { XRDevice } from "iwer";

declare global {
  /** In pages that ran `emulatedHeadset`. */
  var headset: XRDevice;
}

const IWER = readFileSync(createRequire(import.meta.url).resolve("iwer/build/iwer.min.js"), "utf8");

export interface Emulated {
  /** At 5, no machine is too slow. */
  readonly framesPerSecond?: number;
  /** Whether it knows where the floor is. */
  readonly floor?: boolean;
  /** Metres between the eyes. */
  readonly ipd?: number;
}

/** A script that runs before those of the page; the emulator shows the canvas, with an eye in each half. */
export function emulatedHeadset({ framesPerSecond = 5, floor = true, ipd = 0.063 }: Emulated = {}): string {
  const features = floor ? "" : ', supportedFeatures: ["viewer", "local", "hand-tracking"]';
  return `${IWER};
globalThis.headset = new IWER.XRDevice(
  { ...IWER.metaQuest3, internalNominalFrameRate: ${framesPerSecond}${features} },
  { stereoEnabled: true, ipd: ${ipd} },
);
headset.installRuntime({ forceInstall: true });
`;
}
