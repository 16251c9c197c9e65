// SPDX-License-Identifier: Apache-2.0
/** The built player in an emulated headset (iwer, the Immersive Web Emulation Runtime). Skipped where there is no browser. */

import { readFileSync } from "node:fs";
import type { Page } from "playwright-core";
import { beforeAll, describe, expect, test, vi } from "vitest";
import type { XrMode } from "../../src/xr/session.ts";
import { type Emulated, emulatedHeadset } from "./headset.ts";
import { ask, reported, StagedTests, shows } from "./stage.ts";

vi.setConfig({ testTimeout: 120_000, hookTimeout: 60_000 });

interface Eye {
  /** Column by column, of the drawn moment. */
  readonly projection: number[];
  readonly inverse: number[];
  /** Centroids of the red, green and blue dot in pixels of the eye's picture, from its top left; NaN without one. */
  readonly dots: [x: number, y: number][];
  /** Red, green, blue and alpha of a corner, 0 to 255. */
  readonly corner: number[];
}

declare global {
  /** What the next picture shows, by eye. */
  var nextPicture: () => Promise<Eye[]>;
}

const [WIDTH, HEIGHT] = [160, 240];
/** Of the eyes; a wide one, so that a pixel is a small part of the disparity. */
const IPD = 0.3;
/** Capture of `make_dots.py`: metres, z up; the camera in the middle is at (0, -3, 1.2) and looks along y. */
const DOTS = [[0, 0, 1.5], [0.6, 0.3, 0.9], [-0.7, 1, 2]] as const; // biome-ignore format: a row for each
const ENVIRONMENT = [56, 56, 128];

/** Runs before the page: pictures go to a framebuffer like that of a real headset, and are read from there. */
const READING = `
let made, gl, views = [];
Object.defineProperty(XRWebGLLayer.prototype, "framebuffer", { get() {
  if (made) return made;
  gl = this.context;
  made = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, this.framebufferWidth, this.framebufferHeight);
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D), 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return made;
} });
const { getViewerPose } = XRFrame.prototype;
XRFrame.prototype.getViewerPose = function (space) {
  const pose = getViewerPose.call(this, space);
  views = pose.views.map(({ projectionMatrix, transform }) => ({ projection: [...projectionMatrix], inverse: [...transform.inverse.matrix] }));
  return pose;
};
function read() {
  const pixels = new Uint8Array(${2 * WIDTH} * ${HEIGHT} * 4);
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  gl.readPixels(0, 0, ${2 * WIDTH}, ${HEIGHT}, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return pixels;
}
globalThis.nextPicture = async () => {
  const player = document.querySelector("structgstream-player");
  const pixels = await new Promise((resolve) => {
    const remove = player.on("drawn", ({ stats }) => {
      if (stats.frameIndex === undefined) return;
      remove();
      resolve(read());
    });
  });
  return views.map((view, eye) => {
    const sums = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
    for (let y = 0; y < ${HEIGHT}; y++) for (let x = 0; x < ${WIDTH}; x++) {
      const at = 4 * (${2 * WIDTH} * y + ${WIDTH} * eye + x);
      // A dot's own channel is the only one that exceeds the environment's.
      [80, 80, 150].forEach((least, channel) => {
        const weight = Math.max(pixels[at + channel] - least, 0);
        [x + 0.5, ${HEIGHT} - y - 0.5, 1].forEach((value, i) => (sums[channel][i] += weight * value));
      });
    }
    const dots = sums.map(([x, y, weight]) => [x / weight, y / weight]);
    return { ...view, dots, corner: [...pixels.subarray(4 * ${WIDTH} * eye, 4 * ${WIDTH} * eye + 4)] };
  });
};`;

/** Pixels of a point of the room in an eye's picture, by WebXR's matrices alone. */
function projected({ projection, inverse }: Eye, point: readonly number[]): [number, number] {
  const times = (m: number[], v: readonly number[]) =>
    [0, 1, 2, 3].map((row) => v.reduce((sum, value, column) => sum + m[4 * column + row]! * value, 0));
  const [x, y, , w] = times(projection, times(inverse, [...point, 1])) as [number, number, number, number];
  return [((x / w + 1) / 2) * WIDTH, ((1 - y / w) / 2) * HEIGHT];
}

/** Where a point of the capture is in the room of a viewer who stands where the camera stands. */
function inRoom([x, y, z]: readonly [number, number, number], metres = 1): [number, number, number] {
  return [x * metres, z * metres, -(y + 3) * metres];
}

/** Draws until the picture is of a head that does not move, then compares each dot in each eye with its projection. */
async function expectDots(page: Page, inTheRoom: (dot: readonly [number, number, number]) => number[]): Promise<Eye[]> {
  await page.waitForFunction(() => document.querySelector("structgstream-player")!.stats!.settled);
  const eyes = await page.evaluate(() => nextPicture());
  expect(eyes.length).toBe(2);
  for (const eye of eyes) {
    for (const [i, dot] of DOTS.entries()) {
      const [x, y] = projected(eye, inTheRoom(dot));
      expect(x).toBeGreaterThan(3);
      expect(x).toBeLessThan(WIDTH - 3);
      expect(Math.abs(eye.dots[i]![0] - x)).toBeLessThan(0.4);
      expect(Math.abs(eye.dots[i]![1] - y)).toBeLessThan(0.4);
    }
  }
  return eyes;
}

/** Some pictures later, so that the emulator has passed on what was set. */
async function later(page: Page, pictures = 3): Promise<void> {
  for (let i = 0; i < pictures; i++) await page.evaluate(() => nextPicture());
}

describe.skipIf(StagedTests.skipped)("the player in a headset", () => {
  const stage = new StagedTests();

  beforeAll(() => {
    for (const path of ["../fixtures/dots.sgs", "../../../gl/test/fixtures/patch.sgs"]) {
      stage.server.put(path.slice(path.lastIndexOf("/")), new Uint8Array(readFileSync(new URL(path, import.meta.url))));
    }
  });

  /** A page with a headset at the first frame. */
  async function opened(attributes = 'src="dots.sgs"', emulated: Emulated = {}): Promise<Page> {
    const script = emulatedHeadset({ ipd: IPD, ...emulated }) + READING;
    const page = await stage.open(attributes, "", {}, script);
    await shows(page, 0);
    return page;
  }

  /** The same in a session. */
  async function entered(attributes?: string, mode: XrMode = "immersive-vr", emulated?: Emulated): Promise<Page> {
    const page = await opened(attributes, emulated);
    await page.evaluate((asked) => {
      for (const hand of ["left", "right"] as const) headset.controllers[hand]!.connected = true;
      return document.querySelector("structgstream-player")!.enterXr(asked);
    }, mode);
    await later(page);
    return page;
  }

  test("both eyes see the scene as large and as high as it is, from where the camera stands", async () => {
    const page = await entered();
    expect(await ask(page, (player) => player.xr)).toBe("immersive-vr");
    const eyes = await expectDots(page, inRoom);
    // Disparity is focal length times distance of the eyes, over depth.
    const focal = (eyes[0]!.projection[0]! * WIDTH) / 2;
    for (const [i, [, y]] of DOTS.entries()) {
      const disparity = eyes[0]!.dots[i]![0] - eyes[1]!.dots[i]![0];
      expect(disparity).toBeGreaterThan(5);
      expect(Math.abs(disparity - (focal * IPD) / (y + 3))).toBeLessThan(0.3);
    }
    for (const { corner } of eyes) {
      for (const [i, value] of [...ENVIRONMENT, 255].entries()) expect(Math.abs(corner[i]! - value)).toBeLessThan(2);
    }
    // A step forward and to the right, lower, with the head turned to the left.
    await page.evaluate(() => {
      headset.position.set(0.3, 1.1, -0.5);
      headset.quaternion.set(0, Math.sin(0.1), 0, Math.cos(0.1));
    });
    await later(page);
    await expectDots(page, inRoom);
  });

  test("a device that does not know its floor has one below the eyes", async () => {
    const page = await entered(undefined, "immersive-vr", { floor: false });
    await expectDots(page, inRoom);
  });

  test("a context that the headset's GPU needs anew draws the same, and one that is lost ends the session", async () => {
    const page = await opened();
    await page.evaluate(() => {
      WebGL2RenderingContext.prototype.makeXRCompatible = async function () {
        const lost = this.getExtension("WEBGL_lose_context")!;
        const restored = new Promise((resolve) => this.canvas.addEventListener("webglcontextrestored", resolve));
        lost.loseContext();
        setTimeout(() => lost.restoreContext(), 50);
        await restored;
      };
      return document.querySelector("structgstream-player")!.enterXr();
    });
    await later(page);
    await expectDots(page, inRoom);
    // One that is lost later ends the session, whose framebuffer is lost with it.
    await page.evaluate(() => {
      const gl = document.querySelector("canvas")!.getContext("webgl2")!; // where the emulator shows it
      const extension = gl.getExtension("WEBGL_lose_context")!;
      extension.loseContext();
      setTimeout(() => extension.restoreContext(), 300);
    });
    await page.waitForFunction(() => document.querySelector("structgstream-player")!.xr === undefined);
    await shows(page, 0);
    // The emulator clears the lost context until the page hears of it.
    stage.expectComplaints(/CONTEXT_LOST_WEBGL|WebGL context was lost|reading '0'/);
  });

  test("the attribute metres is the size of the capture's unit", async () => {
    const page = await entered('src="dots.sgs" metres="2"');
    await expectDots(page, (dot) => inRoom(dot, 2));
  });

  test("a trigger plays and pauses, a stick turns and moves, a grip pulls", async () => {
    const page = await entered();
    const paused = () => ask(page, (player) => player.paused);
    const trigger = async (value: number) => {
      await page.evaluate((to) => headset.controllers.right!.updateButtonValue("trigger", to), value);
      await later(page);
    };
    for (const expected of [false, true]) {
      await trigger(1);
      expect(await paused()).toBe(!expected);
      await trigger(0);
      expect(await paused()).toBe(expected);
    }
    const turn = (steps: number) => (dot: readonly [number, number, number]) => {
      // The scene turns to the left around the head when the viewer turns to the right.
      const [x, y, z] = inRoom(dot);
      const [sine, cosine] = [Math.sin((steps * Math.PI) / 6), Math.cos((steps * Math.PI) / 6)];
      return [x * cosine + z * sine, y, z * cosine - x * sine];
    };
    const stick = async (x: number, y: number) => {
      await page.evaluate(([a, b]) => headset.controllers.left!.updateAxes("thumbstick", a!, b!), [x, y]);
      await later(page);
    };
    // Held, it turns once; then back.
    await stick(-1, 0);
    await later(page);
    // To see what is then at the right edge, the head looks there.
    await page.evaluate(() => headset.quaternion.set(0, Math.sin(-Math.PI / 12), 0, Math.cos(-Math.PI / 12)));
    await later(page);
    await expectDots(page, turn(-1));
    await stick(0, 0);
    await stick(1, 0);
    await page.evaluate(() => headset.quaternion.set(0, 0, 0, 1));
    await stick(0, 0);
    await expectDots(page, inRoom);
    // Pulled by the grip to the left and down, and not paused by it.
    const grip = (value: number) =>
      page.evaluate((to) => headset.controllers.right!.updateButtonValue("squeeze", to), value);
    await grip(1);
    await later(page);
    await page.evaluate(() => {
      const { position } = headset.controllers.right!;
      position.set(position.x - 0.25, position.y - 0.2, position.z);
    });
    await later(page);
    await grip(0);
    await later(page);
    const shifted = (dot: readonly [number, number, number]) => {
      const [x, y, z] = inRoom(dot);
      return [x - 0.25, y - 0.2, z];
    };
    await expectDots(page, shifted);
    expect(await paused()).toBe(true);
    // A trigger that is moved pulls, too, and does not play.
    await trigger(1);
    const lift = async (metres: number) => {
      await page.evaluate((by) => {
        headset.controllers.right!.position.y += by;
      }, metres);
      await later(page);
    };
    await lift(0.05);
    await lift(0.2);
    await trigger(0);
    await expectDots(page, (dot) => {
      const [x, y, z] = shifted(dot);
      return [x!, y! + 0.2, z!];
    });
    expect(await paused()).toBe(true);
    // So does a pinch play and pause.
    await page.evaluate(() => {
      headset.primaryInputMode = "hand";
      headset.hands.left!.connected = true;
      headset.hands.left!.updatePinchValue(1);
    });
    await later(page);
    await page.evaluate(() => headset.hands.left!.updatePinchValue(0));
    await later(page);
    expect(await paused()).toBe(false);
    await page.evaluate(() => {
      headset.primaryInputMode = "controller";
      document.querySelector("structgstream-player")!.pause();
    });
    await later(page);
    // Forward: what is ahead comes nearer, so that the eyes differ more.
    const disparity = async () => {
      const eyes = await page.evaluate(() => nextPicture());
      return eyes[0]!.dots[0]![0] - eyes[1]!.dots[0]![0];
    };
    const before = await disparity();
    await stick(0, -1);
    for (let n = 0; n < 3; n++) await later(page); // a picture moves it by 0.15 m at most
    await stick(0, 0);
    expect(await disparity()).toBeGreaterThan(before + 0.5);
  });

  test("a button enters and leaves; the page's picture, size and camera are as before", async () => {
    const page = await opened();
    const state = () =>
      ask(page, (player) => {
        const canvas = player.shadowRoot!.querySelector("canvas")!;
        return { camera: [...player.camera!.viewmat], size: [canvas.width, canvas.height], xr: player.xr };
      });
    const before = await state();
    await page.evaluate(() => {
      Object.assign(globalThis, { modes: [] });
      document
        .querySelector("structgstream-player")!
        .on("xr", ({ mode }) => (globalThis as never as { modes: unknown[] }).modes.push(mode ?? "none"));
    });
    expect(await page.getByRole("button", { name: "Enter AR" }).count()).toBe(1);
    await page.getByRole("button", { name: "Enter VR" }).click();
    await page.waitForFunction(() => document.querySelector("structgstream-player")!.xr === "immersive-vr");
    await later(page);
    // It plays on in the headset.
    await ask(page, (player) => void player.play());
    await page.waitForFunction(() => heard.frames.at(-1)! >= 2);
    await ask(page, (player) => player.pause());
    const button = page.getByRole("button", { name: "Leave VR" });
    expect(await button.getAttribute("aria-pressed")).toBe("true");
    await button.dispatchEvent("click"); // the emulator's canvas covers the page
    await page.waitForFunction(() => document.querySelector("structgstream-player")!.xr === undefined);
    await ask(page, (player) => player.seek(0));
    await shows(page, 0);
    expect(await state()).toEqual(before);
    expect(await page.evaluate("modes")).toEqual(["immersive-vr", "none"]);
    // A device that ends the session by itself, and a player that leaves the page.
    await ask(page, (player) => player.enterXr());
    await later(page);
    await page.evaluate(() => headset.activeSession!.end());
    await page.waitForFunction(() => document.querySelector("structgstream-player")!.xr === undefined);
    await shows(page, 0);
    await ask(page, (player) => player.enterXr());
    await later(page);
    await ask(page, (player) => player.destroy());
    await page.waitForFunction(() => headset.activeSession === undefined);
  });

  test("pictures that come late cost splats, until the session ends", async () => {
    const page = await entered('src="patch.sgs"', "immersive-vr", { framesPerSecond: 90 });
    const first = await ask(page, (player) => player.stats!.splats);
    await page.evaluate(() => {
      // Every picture takes four intervals of the headset longer.
      document.querySelector("structgstream-player")!.on("drawn", () => {
        const until = performance.now() + 45;
        while (performance.now() < until);
      });
    });
    await page.waitForFunction(
      (all) => document.querySelector("structgstream-player")!.stats!.splats < 0.6 * all,
      first,
      {
        timeout: 60_000,
      },
    );
    // Out of the headset it is as before.
    await ask(page, (player) => player.exitXr());
    await shows(page, 0);
    expect(await ask(page, (player) => player.stats!.splats)).toBeGreaterThan(0.8 * first);
  });

  test("in front of the camera's picture nothing is behind the scene", async () => {
    const page = await entered('src="dots.sgs"', "immersive-ar");
    expect(await ask(page, (player) => player.xr)).toBe("immersive-ar");
    const eyes = await expectDots(page, inRoom);
    for (const { corner } of eyes) expect(corner).toEqual([0, 0, 0, 0]);
  });

  test("errors are sentences", async () => {
    const page = await opened();
    const refusal = (mode: XrMode = "immersive-vr") =>
      page.evaluate(async (asked) => {
        try {
          await document.querySelector("structgstream-player")!.enterXr(asked);
          return "entered";
        } catch (error) {
          return String(error);
        }
      }, mode);
    await page.evaluate(() => document.querySelector("structgstream-player")!.setAttribute("metres", "tall"));
    expect(await refusal()).toBe('Error: The attribute metres is "tall"; expected the metres per unit of the capture.');
    await page.evaluate(() => {
      document.querySelector("structgstream-player")!.removeAttribute("metres");
      navigator.xr!.requestSession = () => Promise.reject(new DOMException("No permission.", "SecurityError"));
    });
    expect(await refusal()).toBe(
      "Error: The session was refused (No permission); ask for it in a click, and allow it.",
    );
    await page.evaluate(() => {
      navigator.xr!.requestSession = () => Promise.reject(new DOMException("No.", "NotSupportedError"));
    });
    expect(await refusal("immersive-ar")).toMatch(/^Error: This device does not offer immersive-ar/);
    await page.evaluate(() => {
      const { xr } = navigator;
      delete (xr as { requestSession?: unknown }).requestSession;
      WebGL2RenderingContext.prototype.makeXRCompatible = () => Promise.reject(new DOMException("No such GPU."));
    });
    expect(await refusal()).toBe(
      "Error: The headset cannot show this player's pictures (No such GPU); load the page again.",
    );
    expect(await page.evaluate(() => headset.activeSession)).toBeUndefined();
    await page.evaluate(() => {
      navigator.xr!.requestSession = () => Promise.reject(new DOMException("No.", "NotSupportedError"));
    });
    // By the button it is a note.
    await page.getByRole("button", { name: "Enter VR" }).click();
    await page.getByText("This device does not offer immersive-vr").waitFor();
    await page.evaluate(() => Object.defineProperty(navigator, "xr", { value: undefined }));
    expect(await refusal()).toMatch(/^Error: This browser has no WebXR/);
    expect(await reported(page)).toEqual([]);
    expect(await ask(page, (player) => player.xr)).toBeUndefined();
  });

  test("without a headset there is no button", async () => {
    const page = await stage.open('src="dots.sgs"');
    await shows(page, 0);
    for (const name of ["Enter VR", "Enter AR"]) expect(await page.getByRole("button", { name }).count()).toBe(0);
  });
});
