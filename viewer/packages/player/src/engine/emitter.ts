// SPDX-License-Identifier: Apache-2.0

/** Calls listeners; `Events` maps names of events to their data. */
export class Emitter<Events extends object> {
  /** Receives every event, after its listeners. */
  relay: ((name: keyof Events, event: unknown) => void) | undefined;
  private readonly listeners = new Map<keyof Events, Set<(event: never) => void>>();

  /** @returns a function that removes the listener */
  on<Name extends keyof Events>(name: Name, listener: (event: Events[Name]) => void): () => void {
    const set = this.listeners.get(name) ?? new Set();
    this.listeners.set(name, set.add(listener as (event: never) => void));
    return () => void set.delete(listener as (event: never) => void);
  }

  emit<Name extends keyof Events>(name: Name, event: Events[Name]): void {
    for (const listener of [...(this.listeners.get(name) ?? [])]) (listener as (event: Events[Name]) => void)(event);
    this.relay?.(name, event);
  }

  clear(): void {
    this.listeners.clear();
    this.relay = undefined;
  }
}
