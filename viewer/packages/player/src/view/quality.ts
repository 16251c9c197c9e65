// SPDX-License-Identifier: Apache-2.0
/** How much is drawn: splats, and pixels. A device that is too slow gets fewer pixels, and later more again. */

/** What is known of a device before anything was drawn. */
export interface Device {
  readonly coarsePointer: boolean;
  readonly memoryGigabytes: number | undefined;
  readonly processors: number;
}

export interface Quality {
  readonly maxSplats: number;
  /** Side of what is drawn, in pixels of the screen. */
  readonly pixelScale: number;
}

/** "auto", or what the user wants. */
export interface QualityChoice {
  readonly maxSplats: number | "auto";
  readonly pixelScale: number | "auto";
}

const WEAK_SPLATS = 180_000;
const SCALES: readonly number[] = [1, 0.75, 0.5, 0.35];
/** Pictures this far apart are too slow; this close there may be room. */
const SLOW_SECONDS = 1 / 24;
const QUICK_SECONDS = 1 / 50;
/** So many pictures in a row decide, and after a change so many are waited for. */
const ENOUGH = 12;
/** A scale that was too much is not tried again before so many pictures. */
const RETRY_AFTER = 600;

export class QualityControl {
  choice: QualityChoice = { maxSplats: "auto", pixelScale: "auto" };
  private readonly weak: boolean;
  private level: number;
  private slow = 0;
  private quick = 0;

  constructor(device: Device) {
    const little = (device.memoryGigabytes ?? 8) <= 4 || device.processors <= 4;
    this.weak = device.coarsePointer && little;
    this.level = device.coarsePointer ? 1 : 0;
  }

  get current(): Quality {
    const { maxSplats, pixelScale } = this.choice;
    const automatic = this.weak ? WEAK_SPLATS : Number.POSITIVE_INFINITY;
    return {
      maxSplats: maxSplats === "auto" ? automatic : maxSplats,
      pixelScale: pixelScale === "auto" ? SCALES[this.level]! : pixelScale,
    };
  }

  /** Learns how long it is since the picture before, while pictures follow each other without a pause. */
  picture(seconds: number): void {
    if (this.choice.pixelScale !== "auto") return;
    this.slow = seconds > SLOW_SECONDS ? this.slow + 1 : Math.min(this.slow, 0);
    this.quick = seconds < QUICK_SECONDS ? this.quick + 1 : 0;
    if (this.slow >= ENOUGH && this.level < SCALES.length - 1) this.change(1);
    else if (this.quick >= RETRY_AFTER && this.level > 0) this.change(-1);
  }

  private change(by: number): void {
    this.level += by;
    this.slow = -ENOUGH;
    this.quick = 0;
  }
}
