// SPDX-License-Identifier: Apache-2.0
/** Statistics of a stream: bytes by field, bit rate, and times. */

import type { FieldName } from "@structgstream/core";
import type { Player } from "../player.js";
import { made, setText } from "./dom.js";
import { bytesText } from "./format.js";

const EVERY_SECONDS = 0.2;
const HEAD_BYTES = 24;

export class Statistics {
  private readonly facts = new Map<string, HTMLElement>();
  private readonly list = made("dl", { class: "facts" });
  private readonly fields = new Map<FieldName, { readonly row: HTMLElement; readonly bytes: HTMLElement }>();
  private readonly byField = made("div");
  private readonly title = made("h3");
  private updatedAt = Number.NEGATIVE_INFINITY;

  constructor(private readonly player: Player) {}

  content(): Node[] {
    return [this.list, this.title, this.byField];
  }

  /** Must be called with every picture while the panel is open. */
  update(now: number): void {
    if (now - this.updatedAt < EVERY_SECONDS) return;
    this.updatedAt = now;
    const { engine, pictureSeconds } = this.player;
    const stats = this.player.drawnStats;
    if (!engine) return;
    const index = stats?.frameIndex ?? engine.frameIndex;
    this.set("Frame", `${index} of ${engine.frames.count}`);
    this.set("Pictures a second", pictureSeconds ? (1 / pictureSeconds).toFixed(0) : "–");
    const { ageSeconds } = this.player;
    if (ageSeconds !== undefined) this.set("Filmed", `${ageSeconds.toFixed(1)} s ago`);
    this.set("Bit rate, last second", this.rateText(index));
    this.set("Fetched", bytesText(engine.stored.fetchedBytes));
    this.set("Splats drawn", stats ? stats.splats.toLocaleString("en") : "–");
    this.set("Decoding, worker", `${engine.packets.decodeMilliseconds.toFixed(1)} ms`);
    this.set("Sorting, worker", stats ? `${stats.sortMilliseconds.toFixed(1)} ms` : "–");
    this.set("Main thread a picture", stats ? `${stats.callMilliseconds.toFixed(1)} ms` : "–");
    this.updateFields(index);
  }

  private set(name: string, value: string): void {
    let cell = this.facts.get(name);
    if (!cell) {
      cell = made("dd");
      this.facts.set(name, cell);
      this.list.append(made("dt", {}, name), cell);
    }
    setText(cell, value);
  }

  /** Bit rate of the decoded frames in the last second. */
  private rateText(index: number): string {
    const { frames } = this.player.engine!;
    let bytes = 0;
    let from = index;
    for (let i = index; i >= 0 && frames.ptsOf(index) - frames.ptsOf(i) < 1; i--) {
      const facts = this.player.engine!.packets.of(i);
      if (!facts) break;
      bytes += facts.bytes;
      from = i;
    }
    const seconds = frames.endOf(index) - frames.ptsOf(from);
    return bytes && seconds > 0 ? `${((8 * bytes) / seconds / 1e6).toFixed(2)} Mbit/s` : "–";
  }

  private updateFields(index: number): void {
    const packet = this.player.engine?.packets.of(index);
    if (!packet) return;
    setText(this.title, `${packet.isKey ? "Key" : "Delta"} packet, ${bytesText(packet.bytes)}`);
    for (const [name, bytes] of packet.byField) {
      const { row, bytes: cell } = this.field(name);
      row.style.setProperty("--share", `${((100 * bytes) / Math.max(packet.bytes - HEAD_BYTES, 1)).toFixed(1)}%`);
      setText(cell, bytesText(bytes));
    }
  }

  private field(name: FieldName): { readonly row: HTMLElement; readonly bytes: HTMLElement } {
    const known = this.fields.get(name);
    if (known) return known;
    const bytes = made("span");
    const row = made("div", { class: "field" }, made("span", {}, name.replaceAll("_", " ")), bytes, made("i"));
    this.byField.append(row);
    this.fields.set(name, { row, bytes });
    return { row, bytes };
  }
}
