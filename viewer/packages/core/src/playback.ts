// SPDX-License-Identifier: Apache-2.0
/** Plays the frames of a stream in the loop of any renderer. */

import type { Frame } from "./decoder.js";
import { StreamError } from "./errors.js";
import type { PacketInfo, StreamReader } from "./reader.js";

/** Seconds between two updates that count at most, so that a hidden page pauses. */
const MAX_STEP_SECONDS = 1;

export interface PlaybackOptions {
  /** Called when the last frame has been shown for its time; not with `loop`. */
  readonly ended?: () => void;
}

/**
 * Decides which frame is shown when. All times are seconds of the stream, as in its packets.
 *
 * A renderer calls `update` before each of its pictures. Frames are decoded on this thread, at most one is shown for an update.
 */
export class Playback {
  loop = false;
  playbackRate = 1;
  private readonly packets: readonly PacketInfo[];
  private readonly endSeconds: number;
  private time: number;
  private running = false;
  private atEnd = false;
  private updatedSeconds: number | undefined;
  private shown: number | undefined;

  /**
   * @param reader a whole file's reader; frames that were lost to damage are left out
   * @param show takes each frame that becomes the present one
   * @throws StreamError there is no frame that can be shown
   */
  constructor(
    private readonly reader: StreamReader,
    private readonly show: (frame: Frame) => void,
    private readonly options: PlaybackOptions = {},
  ) {
    this.packets = decodable(reader);
    const last = this.packets.at(-1);
    if (!reader.header || !last) throw new StreamError(`${reader.name} has no frame that can be shown.`);
    this.endSeconds = last.ptsSeconds + 1 / reader.header.fps;
    this.time = this.packets[0]!.ptsSeconds;
  }

  /** The end of the last frame. */
  get duration(): number {
    return this.endSeconds;
  }

  get currentTime(): number {
    return this.time;
  }

  get paused(): boolean {
    return !this.running;
  }

  get ended(): boolean {
    return this.atEnd;
  }

  /** Continues, or starts again after the end. */
  play(): void {
    if (this.atEnd) this.seek(this.packets[0]!.ptsSeconds);
    if (!this.running) this.updatedSeconds = undefined;
    this.running = true;
  }

  pause(): void {
    this.running = false;
  }

  /** Goes to a time; the next update shows its frame. */
  seek(seconds: number): void {
    this.atEnd = false;
    this.time = Math.min(Math.max(seconds, this.packets[0]!.ptsSeconds), this.endSeconds);
  }

  /**
   * Advances to a time of the renderer's clock, and shows the frame that is due if it is not shown yet.
   *
   * @param nowSeconds of any clock that never goes back
   * @throws StreamError the frame is damaged
   */
  update(nowSeconds: number): void {
    if (this.running) {
      const elapsed = Math.min(nowSeconds - (this.updatedSeconds ?? nowSeconds), MAX_STEP_SECONDS);
      this.time += elapsed * this.playbackRate;
    }
    this.updatedSeconds = nowSeconds;
    const ends = this.running && this.time >= this.endSeconds;
    if (ends && this.loop) this.time = this.packets[0]!.ptsSeconds;
    this.showDue();
    if (!ends || this.loop) return;
    this.time = this.endSeconds;
    this.running = false;
    this.atEnd = true;
    this.options.ended?.();
  }

  private showDue(): void {
    let [low, high] = [0, this.packets.length - 1];
    while (low < high) {
      const middle = Math.ceil((low + high) / 2);
      if (this.packets[middle]!.ptsSeconds <= this.time + 1e-6) low = middle;
      else high = middle - 1;
    }
    const { index } = this.packets[low]!;
    if (index === this.shown) return;
    this.show(this.reader.frame(index));
    this.shown = index;
  }
}

/** Packets that need no lost one. */
function decodable({ packets, header }: StreamReader): PacketInfo[] {
  let next = -1;
  return packets.filter(({ index, isKey }) => {
    const fits = isKey || header?.codec === "raw" || index === next;
    if (fits) next = index + 1;
    return fits;
  });
}
