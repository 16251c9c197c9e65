// SPDX-License-Identifier: Apache-2.0
/** Modules import each other in one direction, and others see one of them, the barrel. */

import { readdirSync, readFileSync } from "node:fs";
import { posix } from "node:path";
import { fileURLToPath } from "node:url";
import { expect, test } from "vitest";

/** By package: each module and the modules of the package that it imports. */
function graphOf(name: string): Map<string, string[]> {
  const folder = fileURLToPath(new URL(`../../${name}/src/`, import.meta.url));
  const files = readdirSync(folder, { recursive: true }).map(String);
  const modules = files.filter((file) => file.endsWith(".ts") && !file.endsWith(".d.ts"));
  return new Map(
    modules.map((file) => {
      const imports = readFileSync(folder + file, "utf8").matchAll(/from "(\.[^"]+)\.js"/g);
      return [file.slice(0, -3), [...imports].map((found) => posix.join(posix.dirname(file), found[1]!))];
    }),
  );
}

/** A way from a module back to itself, if there is one. */
function circleIn(graph: Map<string, string[]>): string[] | undefined {
  const done = new Set<string>();
  function from(name: string, way: string[]): string[] | undefined {
    if (way.includes(name)) return [...way.slice(way.indexOf(name)), name];
    if (done.has(name)) return undefined;
    for (const next of graph.get(name) ?? []) {
      const found = from(next, [...way, name]);
      if (found) return found;
    }
    done.add(name);
    return undefined;
  }
  for (const name of graph.keys()) {
    const found = from(name, []);
    if (found) return found;
  }
  return undefined;
}

test("a circle is found", () => {
  const graph = new Map([
    ["a", ["b"]],
    ["b", ["c"]],
    ["c", ["b"]],
  ]);
  expect(circleIn(graph)).toEqual(["b", "c", "b"]);
});

test.each(["core", "gl", "player", "spark", "playcanvas"])("%s has no circle of imports", (name) => {
  const graph = graphOf(name);
  expect([...graph.values()].flat().length).toBeGreaterThan(1);
  expect(circleIn(graph)).toBeUndefined();
});

test.each(["core", "gl", "spark", "playcanvas"])("index.ts of %s only exports, and no module imports it", (name) => {
  const folder = fileURLToPath(new URL(`../../${name}/src/`, import.meta.url));
  const code = readFileSync(`${folder}index.ts`, "utf8").replace(/\/\*[\s\S]*?\*\/|\/\/.*/g, "");
  expect(code.replace(/export (type )?\{[^}]*\} from "[^"]+";/g, "").trim()).toBe("");
  expect([...graphOf(name).values()].flat()).not.toContain("index");
});
