// SPDX-License-Identifier: Apache-2.0
/** The numbers of drawn splats and pixels. A device that is too slow gets fewer pixels, and later more again. */

/** Facts of a device before the first picture. */
export interface Device {
  readonly coarsePointer: boolean;
  readonly memoryGigabytes: number | undefined;
  readonly processors: number;
}

export interface Quality {
  readonly maxSplats: number;
  /** Scale of the drawn picture relative to pixels of the screen. */
  readonly pixelScale: number;
}

/** "auto", or the user's choice. */
export interface QualityChoice {
  readonly maxSplats: number | "auto";
  readonly pixelScale: number | "auto";
}

const WEAK_SPLATS = 180_000;
const SCALES: readonly number[] = [1, 0.75, 0.5, 0.35];
/** Intervals between pictures above which a device is too slow, and below which it may have a reserve. */
const SLOW_SECONDS = 1 / 24;
const QUICK_SECONDS = 1 / 50;
/** Number of consecutive pictures for a decision, and of pictures to wait after a change. */
const ENOUGH = 12;
/** Number of pictures after which a scale that was too large is tried again. */
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

  /** Adds the time since the last picture; called while pictures are consecutive. */
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
