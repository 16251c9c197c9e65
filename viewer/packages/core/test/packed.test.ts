// SPDX-License-Identifier: Apache-2.0
/** The packages as npm packs them, installed in an empty project, checked against their types, bundled and run. */

import { execFileSync } from "node:child_process";
import { mkdtempSync, readdirSync, realpathSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, expect, test } from "vitest";
import { bytesOf, VECTORS } from "./streams.ts";

const PACKAGES = ["core", "gl", "spark", "playcanvas"];
/** What the packages and the program need, from the workspace's own installation: no registry is asked. */
const FROM_WORKSPACE = ["fzstd", "three", "@types/three", "@sparkjsdev/spark", "playcanvas", "@types/node"];
const VIEWER = fileURLToPath(new URL("../../../", import.meta.url));

const NODE_PROGRAM = `
import { readFileSync } from "node:fs";
import { GaussianEvaluator, type Gaussians, Playback, readStream } from "@structgstream/core";
const reader = readStream(readFileSync("ball.sgs"));
const evaluator = new GaussianEvaluator(reader.header!);
let found: Gaussians | undefined;
const playback = new Playback(reader, ({ fields }) => { found = evaluator.evaluate(fields, [0, 0, 0]); });
playback.update(0);
console.log(found!.count);
`;
const BROWSER_PROGRAM = `
import { SparkRenderer } from "@sparkjsdev/spark";
import { StreamClip as Entities, RENDERING as SCENE } from "@structgstream/playcanvas";
import { RENDERING, StreamClip } from "@structgstream/spark";
import { SplatRenderer } from "@structgstream/gl";
import type { AppBase, Entity } from "playcanvas";
import { Scene, type WebGLRenderer } from "three";
export async function show(renderer: WebGLRenderer): Promise<void> {
  const clip = await StreamClip.load("ball.sgs");
  new Scene().add(clip, new SparkRenderer({ renderer, ...RENDERING }));
  clip.playback.loop = true;
  clip.playback.play();
}
export async function enter(app: AppBase, camera: Entity): Promise<number> {
  Object.assign(app.scene.gsplat, SCENE);
  const clip = await Entities.load(app, camera, "ball.sgs");
  app.root.addChild(clip.entity);
  return clip.view().eye.distance(clip.view().target);
}
export const own = (canvas: HTMLCanvasElement) => new SplatRenderer(canvas);
`;

let project: string;
const run = (command: string, ...options: string[]) =>
  execFileSync(command, options, { cwd: project, encoding: "utf8", stdio: ["ignore", "pipe", "inherit"] });

beforeAll(() => {
  project = realpathSync(mkdtempSync(join(tmpdir(), "structgstream-")));
  const folders = PACKAGES.map((name) => `${VIEWER}packages/${name}`);
  run("npm", "pack", "--silent", ...folders);
  const tarballs = readdirSync(project).filter((name) => name.endsWith(".tgz"));
  expect(tarballs.length).toBe(PACKAGES.length);
  writeFileSync(join(project, "package.json"), JSON.stringify({ type: "module", private: true }));
  const others = FROM_WORKSPACE.map((name) => `${VIEWER}node_modules/${name}`);
  run(
    "npm",
    "install",
    "--offline",
    "--no-audit",
    "--no-fund",
    "--silent",
    ...tarballs.map((name) => `./${name}`),
    ...others,
  );
});
afterAll(() => rmSync(project, { recursive: true, force: true }));

test("packages contain what is built, a README and the licence, and nothing else", () => {
  for (const name of PACKAGES) {
    const files = readdirSync(join(project, "node_modules/@structgstream", name));
    expect(files.sort()).toEqual(["LICENSE", "NOTICE", "README.md", "dist", "package.json"]);
  }
});

test("programs are checked against their types, run in Node and are bundled for browsers", () => {
  writeFileSync(join(project, "node.ts"), NODE_PROGRAM);
  writeFileSync(join(project, "browser.ts"), BROWSER_PROGRAM);
  writeFileSync(join(project, "ball.sgs"), bytesOf(VECTORS, "version-2.sgs"));
  const strict = ["--strict", "--target", "es2022", "--module", "esnext", "--moduleResolution", "bundler"];
  const types = ["--skipLibCheck", "--types", "node", "--lib", "es2022,dom"];
  run(join(VIEWER, "node_modules/.bin/tsc"), ...strict, ...types, "--outDir", "out", "node.ts", "browser.ts");
  expect(Number(run("node", "out/node.js"))).toBeGreaterThan(0);
  const esbuild = join(VIEWER, "node_modules/.bin/esbuild");
  run(esbuild, "out/browser.js", "--bundle", "--format=esm", "--outfile=bundle.js", "--log-level=warning");
  expect(readdirSync(project)).toContain("bundle.js");
});
