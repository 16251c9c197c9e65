// SPDX-License-Identifier: Apache-2.0
/** Sound without a browser: a faked AudioContext, whose time a test moves, and the engine that feeds it. */

import { describe, expect, test, vi } from "vitest";
import { Player } from "../src/player.ts";
import { AudioClock } from "../src/sound/audioClock.ts";
import { oggOf } from "../src/sound/ogg.ts";
import { Sound } from "../src/sound/sound.ts";
import { QualityControl } from "../src/view/quality.ts";
import { CLIP, type PlayingOptions, playingFile, ServedFile } from "./served.ts";
import { clappingFile } from "./soundFile.ts";

vi.setConfig({ testTimeout: 30_000 });

const PACKET = 0.02;
/** What a decoder leaves out at the beginning of each chunk. */
const LEFT_OUT = 0.0065;
const LATENCY = 0.03;

/** A source that was started, in context time. */
interface Started {
  readonly at: number;
  readonly from: number;
  readonly length: number;
  readonly rate: number;
  stopped: number | undefined;
}

/** As much of an AudioContext as the player uses. Decoding gives a buffer of the length of the packets. */
class FakeContext {
  state: AudioContextState = "running";
  seconds = 5;
  sampleRate = 48_000;
  baseLatency = 0;
  outputLatency = LATENCY;
  readonly started: Started[] = [];
  readonly decoded: Uint8Array[] = [];
  refuses = false;
  closed = false;
  volume = { value: 1 };
  destination = {};

  get currentTime(): number {
    return this.seconds;
  }

  createGain() {
    const gain = {
      value: 1,
      setValueAtTime: () => undefined,
      linearRampToValueAtTime: () => undefined,
      cancelScheduledValues: () => undefined,
      setTargetAtTime: (value: number) => {
        gain.value = value;
      },
    };
    const connect = (to: unknown) => {
      if (to === this.destination) this.volume = gain;
    };
    return { gain, connect, disconnect() {} };
  }

  createBufferSource() {
    const playbackRate = { value: 1 };
    let own: Started | undefined;
    return {
      buffer: undefined,
      playbackRate,
      connect() {},
      disconnect() {},
      start: (at: number, from: number, length: number) => {
        own = { at, from, length, rate: playbackRate.value, stopped: undefined };
        this.started.push(own);
      },
      stop: (at: number) => {
        if (own) own.stopped = at;
      },
    };
  }

  async decodeAudioData(bytes: ArrayBuffer) {
    const data = new Uint8Array(bytes);
    this.decoded.push(data);
    if (this.refuses) throw new DOMException("no", "EncodingError");
    const packets = oggPackets(data) - 2;
    return { duration: packets * PACKET - LEFT_OUT };
  }

  async resume() {
    if (this.state === "suspended") throw new DOMException("no gesture", "NotAllowedError");
  }

  async close() {
    this.closed = true;
  }
}

/** Packets of an Ogg file, its two heads included. */
function oggPackets(data: Uint8Array): number {
  let packets = 0;
  for (let at = 0; at < data.length; ) {
    expect(Buffer.from(data.subarray(at, at + 4)).toString()).toBe("OggS");
    const segments = data.subarray(at + 27, at + 27 + data[at + 26]!);
    packets += segments.filter((length) => length < 255).length;
    at += 27 + segments.length + segments.reduce((sum, length) => sum + length, 0);
  }
  return packets;
}

function sounding() {
  const context = new FakeContext();
  const notices: string[] = [];
  const gestures = new EventTarget();
  const wall = { seconds: 100 };
  const sound = new Sound({
    startContext: () => context as unknown as AudioContext,
    wall: () => wall.seconds,
    gestures,
    notice: (message) => notices.push(message),
  });
  const pass = (seconds: number) => {
    wall.seconds += seconds;
    if (context.state === "running") context.seconds += seconds;
  };
  return { context, notices, gestures, wall, sound, pass };
}

describe("the clock", () => {
  test("follows what is heard while a context runs, never goes back, and goes on without one", () => {
    const { context, wall } = sounding();
    const clock = new AudioClock(() => wall.seconds);
    const start = clock.now();
    expect(start).toBe(100);
    clock.follow(context as unknown as AudioContext);
    expect(clock.now()).toBe(100);
    context.seconds += 1;
    wall.seconds += 1.02; // the sound card is slower
    expect(clock.now()).toBeCloseTo(101, 9);
    expect(clock.contextTime(102)).toBeCloseTo(context.seconds - LATENCY + 1, 9);
    context.outputLatency = 0.2;
    expect(clock.now()).toBeCloseTo(101, 9);
    context.outputLatency = LATENCY;
    context.state = "suspended";
    wall.seconds += 2;
    expect(clock.now()).toBeCloseTo(101, 9);
    expect(clock.contextTime(102)).toBeUndefined();
    wall.seconds += 2;
    expect(clock.now()).toBeCloseTo(103, 9);
    context.state = "running";
    expect(clock.now()).toBeCloseTo(103, 9);
    // A device that was taken away: time stands still, and pictures do not.
    wall.seconds += 3;
    clock.now();
    wall.seconds += 1;
    expect(clock.now()).toBeGreaterThan(103.9);
  });

  test("takes the output's own time where it is one", () => {
    const { context, wall } = sounding();
    const clock = new AudioClock(() => wall.seconds);
    let stamp = { contextTime: context.seconds - 0.1, performanceTime: 1000 * wall.seconds - 5 };
    clock.follow(Object.assign(context, { getOutputTimestamp: () => stamp }) as unknown as AudioContext);
    expect(clock.now()).toBe(100);
    expect(clock.contextTime(100)).toBeCloseTo(context.seconds - 0.095, 9);
    stamp = { contextTime: 0, performanceTime: 0 };
    context.seconds += 1;
    wall.seconds += 1;
    expect(clock.now()).toBeCloseTo(101.065, 9);
  });
});

describe("an Ogg file", () => {
  test("has the packets, whatever their lengths, and the samples of each page's end", () => {
    const packets = Array.from({ length: 100 }, (_, i) => new Uint8Array((i * 131) % 1276).fill(i));
    const data = oggOf(packets, 2);
    expect(oggPackets(data)).toBe(102);
    expect(data[28 + 9]).toBe(2);
    const pages = [...data.keys()].filter((at) => Buffer.from(data.subarray(at, at + 4)).toString() === "OggS");
    const samples = pages.map((at) => new DataView(data.buffer).getUint32(at + 6, true));
    expect(samples).toEqual([0, 0, 42 * 960, 84 * 960, 100 * 960]);
    expect(pages.map((at) => data[at + 5])).toEqual([2, 0, 0, 0, 4]);
  });
});

describe("the sound", () => {
  const packets = (count: number) => Array.from({ length: count }, () => Uint8Array.of(0xf8, 0xff, 0xfe));
  const settle = () => new Promise((resolve) => setTimeout(resolve, 0));

  test("is scheduled when its pictures are seen, chunk after chunk without a gap", async () => {
    const { context, sound, pass } = sounding();
    sound.begin({ codec: "opus", channels: 1 });
    sound.lagSeconds = 0.025;
    const at = (seconds: number) => sound.update({ audible: true, seconds, rate: 1, now: sound.now() });
    at(0);
    expect(sound.wanted).toBe(true);
    sound.take(sound.serial, [{ index: 0, seconds: 0, packets: packets(50) }]);
    at(0);
    await settle();
    sound.take(sound.serial, [{ index: 1, seconds: 50 * PACKET, packets: packets(40) }]);
    at(0);
    at(0);
    await settle();
    at(0);
    const [first, second] = context.started;
    // Media time 0 is heard at the clock's present time, a latency after it was scheduled, and as pictures are seen.
    const missing = LEFT_OUT; // the decoder gave less than the first chunk's packets
    expect(first!.at + LATENCY).toBeCloseTo(context.seconds + 0.025 + missing, 3);
    expect(first!.length).toBeCloseTo(50 * PACKET - LEFT_OUT, 9);
    expect(second!.at).toBeCloseTo(first!.at + first!.length, 6);
    expect(oggPackets(context.decoded[1]!)).toBe(2 + 8 + 40);
    expect(second!.from).toBeCloseTo(8 * PACKET - LEFT_OUT, 9);
    pass(0.5);
    at(0.5);
    expect(context.started.length).toBe(2);
    // The pictures were held up by more than one may hear.
    pass(0.1);
    at(0.55);
    expect([first!.stopped, second!.stopped]).not.toContain(undefined);
    expect(context.started.length).toBe(4);
    const again = context.started[3]!;
    expect(again.at - second!.at).toBeCloseTo(0.05, 3);
  });

  test("stops with the clock, goes on from what is decoded, and forgets it after a seek", async () => {
    const { context, sound, pass } = sounding();
    sound.begin({ codec: "opus", channels: 2 });
    const at = (seconds: number, audible = true) => sound.update({ audible, seconds, rate: 1, now: sound.now() });
    at(0);
    sound.take(sound.serial, [{ index: 0, seconds: 0, packets: packets(50) }]);
    at(0);
    await settle();
    at(0);
    at(0, false);
    expect(context.started.map(({ stopped }) => stopped)).toEqual([context.seconds + 0.01]);
    pass(10);
    at(0);
    expect(context.started.length).toBe(2);
    expect(context.decoded.length).toBe(1);
    const { serial } = sound;
    sound.flush();
    sound.take(serial, [{ index: 5, seconds: 0.4, packets: packets(50) }]);
    at(7);
    await settle();
    at(7);
    expect(context.started.length).toBe(2);
    expect(context.decoded.length).toBe(1);
  });

  test("muted, nothing is decoded and no context is made; the volume is the context's", async () => {
    const { context, sound } = sounding();
    sound.muted = true;
    sound.begin({ codec: "opus", channels: 1 });
    sound.update({ audible: true, seconds: 0, rate: 1, now: sound.now() });
    expect([sound.wanted, sound.waits, sound.present]).toEqual([false, false, true]);
    sound.muted = false;
    sound.volume = 0.25;
    sound.update({ audible: true, seconds: 0, rate: 1, now: sound.now() });
    expect(sound.wanted).toBe(true);
    expect(context.volume.value).toBe(0.25);
    sound.volume = 1;
    expect(context.volume.value).toBe(1);
    sound.destroy();
    expect(context.closed).toBe(true);
  });

  test("waits for a gesture where the browser wants one, and says so once", async () => {
    vi.useFakeTimers();
    try {
      const { context, sound, gestures, notices, wall } = sounding();
      context.state = "suspended";
      sound.begin({ codec: "opus", channels: 1 });
      for (let i = 0; i < 3; i++) {
        sound.update({ audible: true, seconds: 0, rate: 1, now: sound.now() });
        await vi.advanceTimersByTimeAsync(1000);
      }
      expect([sound.wanted, sound.waits]).toEqual([false, true]);
      expect(notices).toEqual(["The browser plays sound after a click or a key."]);
      const before = sound.now();
      wall.seconds += 1;
      expect(sound.now()).toBeCloseTo(before + 1, 9); // pictures go on
      context.resume = async () => {
        context.state = "running";
      };
      gestures.dispatchEvent(new Event("keydown"));
      await vi.advanceTimersByTimeAsync(0);
      expect([sound.wanted, sound.waits, sound.woke]).toEqual([true, false, true]);
    } finally {
      vi.useRealTimers();
    }
  });

  test("says what a browser cannot do, and the pictures go on", async () => {
    const { context, sound, notices } = sounding();
    sound.begin({ codec: "later", channels: 1 });
    expect(sound.present).toBe(false);
    sound.begin({ codec: "opus", channels: 1 });
    context.refuses = true;
    sound.update({ audible: true, seconds: 0, rate: 1, now: sound.now() });
    sound.take(sound.serial, [{ index: 0, seconds: 0, packets: packets(50) }]);
    sound.update({ audible: true, seconds: 0, rate: 1, now: sound.now() });
    await settle();
    expect(sound.present).toBe(false);
    const none = new Sound({
      startContext: () => {
        throw new TypeError("AudioContext is not defined");
      },
      wall: () => 0,
      notice: (message) => notices.push(message),
    });
    none.begin({ codec: "opus", channels: 1 });
    none.update({ audible: true, seconds: 0, rate: 1, now: 0 });
    expect(notices).toEqual([
      "The stream's sound is of a kind that this player does not know (later).",
      "This browser cannot play the stream's sound, which is Opus.",
      "This browser cannot play sound (AudioContext is not defined).",
    ]);
  });
});

describe("an engine with sound", () => {
  function opened(bytes: Uint8Array, options: PlayingOptions = {}) {
    const given = sounding();
    const file = new ServedFile(bytes);
    const play = playingFile(file, 0, { ...options, sound: given.sound });
    Object.defineProperty(play, "seconds", { get: () => given.sound.now() });
    return { play, file, ...given };
  }

  /** Plays for so long, at twice the speed of the wall's clock; gives back what was begun in the meantime. */
  async function played({ play, pass, context }: ReturnType<typeof opened>, seconds: number): Promise<Started[]> {
    const before = context.started.length;
    for (let at = 0; at < seconds; at += 0.02) {
      pass(0.02);
      play.engine.tick();
      await new Promise((resolve) => setTimeout(resolve, 10));
    }
    return context.started.slice(before);
  }

  test.each([
    ["by its index", true],
    ["as it is read", false],
  ])("plays what is beside the frames, %s, also after a seek and from the start again", async (_, ranges) => {
    const it = opened(clappingFile(8));
    it.file.ranges = ranges;
    await it.play.settled();
    it.play.engine.loop = true;
    it.play.engine.play();
    const first = await played(it, 2);
    const total = first.reduce((sum, { length }) => sum + length, 0);
    expect(total).toBeGreaterThan(2);
    expect(first.every(({ stopped }) => stopped === undefined)).toBe(true);
    for (const [i, one] of first.slice(1).entries()) {
      expect(one.at).toBeCloseTo(first[i]!.at + first[i]!.length, 6);
    }
    const end = first.reduce((sum, { length }) => sum + length, first[0]!.at);
    expect(end + LATENCY - it.context.seconds).toBeGreaterThan(0.3); // enough is scheduled
    it.play.engine.seek(5.25);
    const after = await played(it, 1);
    expect(first.at(-1)!.stopped).toBeDefined();
    expect(after.length).toBeGreaterThan(0);
    // Chunks are on the grid of packets: the first of them lies around the time that was sought.
    const media = it.play.engine.currentTime - (it.context.seconds - LATENCY - after.at(-1)!.at);
    const grid = (media + LEFT_OUT) / PACKET;
    expect(Math.abs(grid - Math.round(grid))).toBeLessThan(0.02 / PACKET);
    await it.play.until(() => {
      it.pass(0.02);
      return it.play.engine.currentTime < 1;
    });
    expect((await played(it, 0.5)).length).toBeGreaterThan(0);
    expect([it.notices, it.play.errors]).toEqual([[], []]);
  });

  test("at another speed it is silent, and it is again at the first", async () => {
    const it = opened(clappingFile(8));
    await it.play.settled();
    it.play.engine.play();
    await played(it, 0.5);
    it.play.engine.playbackRate = 2;
    const decoded = it.context.decoded.length;
    expect(await played(it, 1)).toEqual([]);
    expect(it.context.decoded.length).toBeLessThanOrEqual(decoded + 1);
    it.play.engine.playbackRate = 1;
    expect((await played(it, 1)).length).toBeGreaterThan(0);
  });

  test("a stream without sound makes no context", async () => {
    const it = opened(CLIP);
    const made = vi.spyOn(it.context, "createGain");
    await it.play.settled();
    it.play.engine.play();
    await played(it, 0.3);
    expect(it.play.shown.length).toBeGreaterThan(1);
    expect(made).not.toHaveBeenCalled();
  });

  test("what is evicted is fetched again with its sound", async () => {
    const it = opened(clappingFile(8), { budgetBytes: 4000 });
    const { play } = it;
    await play.settled();
    play.engine.play();
    expect((await played(it, 1)).length).toBeGreaterThan(0);
    play.engine.seek(6);
    expect((await played(it, 0.6)).length).toBeGreaterThan(0);
    play.engine.seek(0.2);
    expect((await played(it, 0.6)).length).toBeGreaterThan(0);
    expect(play.errors).toEqual([]);
  });
});

test("a page that is hidden costs no pixels, and its sound stays where it is", () => {
  let [seconds, index] = [0, 0];
  const quality = new QualityControl({ coarsePointer: false, memoryGigabytes: 8, processors: 8 });
  const renderer = {
    update: () => undefined,
    render: () => ({ drawn: true, frameIndex: index, sortMilliseconds: 0 }),
  };
  const player = new Player({
    renderer: renderer as never,
    quality,
    startPipeline: () => undefined as never,
    now: () => seconds,
    startAudio: () => undefined as never,
  });
  player.engine = { tick: () => ({ index: ++index }) } as never;
  const viewmat = Float64Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  const camera = { viewmat, K: { fx: 1, fy: 1, cx: 0.5, cy: 0.5 }, width: 1, height: 1, near: 0.1 };
  player.view = { camera, pivot: [0, 0, 1] };
  const ticks = (count: number, interval: number, isSeen: boolean) => {
    for (let i = 0; i < count; i++) {
      seconds += interval;
      player.tick(isSeen);
    }
  };
  ticks(200, 1 / 60, true);
  const lag = player.sound.lagSeconds;
  ticks(200, 0.5, false);
  ticks(1, 0.5, true);
  ticks(2, 1 / 60, true);
  expect(player.sound.lagSeconds).toBeCloseTo(lag, 3);
  expect(quality.current.pixelScale).toBe(1);
});
