// SPDX-License-Identifier: Apache-2.0
/**
 * Submits at most one picture ahead of the GPU: a device that is slower than its screen shows fewer pictures, and the
 * page's thread never waits for the GPU.
 */

const POLL_MILLISECONDS = 4;

export class Pace {
  private fence: WebGLSync | null = null;
  private timer: ReturnType<typeof setTimeout> | undefined;

  /** @param onFree called when the GPU is free after `busy` returned true */
  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly onFree: () => void,
  ) {}

  /** Record that a picture was submitted to the GPU. */
  mark(): void {
    this.release();
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
  }

  /** Whether the GPU still renders the last picture; if so, `onFree` will be called. */
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
