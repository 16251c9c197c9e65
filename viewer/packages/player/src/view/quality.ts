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

/** Numbers for the pictures, chosen by the times that they take. */
export interface Pacing {
  readonly current: Quality;
  /** Adds the time since the last picture; called while pictures are consecutive. */
  picture(seconds: number, splats: number): void;
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

export class QualityControl implements Pacing {
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

/** Mean interval between pictures, in intervals of the headset, above which it misses some and below which it misses none. */
const [LATE, IN_TIME] = [1.25, 1.1];
/** A longer interval counts as so many: it is a hitch. */
const HITCH = 2;
const STEP = 0.75;
const MIN_SHARE = 0.1;
const MIN_PIXEL_SCALE = 0.5;
/** Pictures after a change until the next reduction, and until a larger share is tried; the latter is doubled when it fails. */
const [SETTLE_AFTER, TRY_AFTER, MAX_TRY_AFTER] = [30, 600, 9600];

/**
 * The share of splats and pixels that a headset draws in time. A missed picture is felt there, so that splats are left out,
 * too: those with the smallest apparent size. What the user has chosen stays.
 */
export class FrameBudget implements Pacing {
  private share = 1;
  private largest = 0;
  private mean = 1;
  private pictures = 0;
  private tryAfter = TRY_AFTER;
  /** Whether the last change was an increase. */
  private tried = false;

  /** @param frameSeconds between the headset's pictures */
  constructor(
    private readonly quality: QualityControl,
    private readonly frameSeconds: number,
  ) {}

  get current(): Quality {
    const { share, largest } = this;
    const { choice, current } = this.quality;
    const limit = share < 1 && choice.maxSplats === "auto" ? Math.ceil(share * largest) : Number.POSITIVE_INFINITY;
    const factor = choice.pixelScale === "auto" ? Math.max(Math.sqrt(share), MIN_PIXEL_SCALE) : 1;
    return { maxSplats: Math.min(current.maxSplats, limit), pixelScale: current.pixelScale * factor };
  }

  picture(seconds: number, splats: number): void {
    if (this.share === 1) this.largest = Math.max(this.largest, splats);
    this.mean = 0.9 * this.mean + 0.1 * Math.min(seconds / this.frameSeconds, HITCH);
    this.pictures++;
    if (this.mean > LATE && this.pictures >= SETTLE_AFTER && this.share > MIN_SHARE) {
      if (this.tried) this.tryAfter = Math.min(2 * this.tryAfter, MAX_TRY_AFTER);
      this.change(STEP, false);
    } else if (this.mean < IN_TIME && this.pictures >= this.tryAfter && this.share < 1) {
      this.change(1 / STEP, true);
    }
  }

  private change(factor: number, tried: boolean): void {
    this.share = Math.min(Math.max(this.share * factor, MIN_SHARE), 1);
    this.tried = tried;
    this.pictures = 0;
  }
}
