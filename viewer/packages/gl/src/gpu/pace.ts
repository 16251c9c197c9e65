// SPDX-License-Identifier: Apache-2.0
/**
 * No more than one picture ahead of the GPU: a device that takes longer for a picture than its screen does shows fewer,
 * and the page's thread never waits for it.
 */

const POLL_MILLISECONDS = 4;

export class Pace {
  private fence: WebGLSync | null = null;
  private timer: ReturnType<typeof setTimeout> | undefined;

  /** @param onFree the GPU has finished what it was too busy for when `busy` was asked last */
  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly onFree: () => void,
  ) {}

  /** A picture has been handed to the GPU. */
  mark(): void {
    this.release();
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
  }

  /** Whether the GPU is still at the last picture; if so, `onFree` follows. */
  busy(): boolean {
    if (!this.working()) return false;
    this.timer ??= setTimeout(this.poll, POLL_MILLISECONDS);
    return true;
  }

  stop(): void {
    if (this.timer !== undefined) clearTimeout(this.timer);
    this.timer = undefined;
    this.release();
  }

  private working(): boolean {
    if (!this.fence) return false;
    if (this.gl.getSyncParameter(this.fence, this.gl.SYNC_STATUS) === this.gl.UNSIGNALED) return true;
    this.release();
    return false;
  }

  private release(): void {
    if (this.fence) this.gl.deleteSync(this.fence);
    this.fence = null;
  }

  private readonly poll = (): void => {
    this.timer = undefined;
    if (this.working()) this.timer = setTimeout(this.poll, POLL_MILLISECONDS);
    else this.onFree();
  };
}
