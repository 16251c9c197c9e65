// SPDX-License-Identifier: Apache-2.0

/** A worker whose answers come when a test lets them. */
export class HeldWorker {
  onmessage: ((event: MessageEvent) => void) | null = null;
  onerror: ((event: ErrorEvent) => void) | null = null;
  held = false;
  private readonly answers: MessageEvent[] = [];

  constructor(private readonly worker: Worker) {
    worker.onmessage = (event) => {
      this.answers.push(event);
      if (!this.held) this.release();
    };
    worker.onerror = (event) => this.onerror?.(event);
  }

  postMessage(message: unknown, transfer: Transferable[]): void {
    this.worker.postMessage(message, transfer);
  }

  /** Hands out what has come. */
  release(): void {
    this.held = false;
    for (const answer of this.answers.splice(0)) this.onmessage?.(answer);
  }

  terminate(): void {
    this.worker.terminate();
  }
}
