// SPDX-License-Identifier: Apache-2.0
/**
 * Plays the example of a package for many frames, and prints what is on the GPU and in the heap from time to time.
 *
 * npm run leaks --workspace packages/gl -- spark|playcanvas STREAM [FRAMES]; the exit status is 1 if something grows.
 */

import type { ExampleStage } from "../test/support/examplePage.ts";
import { grown, openExample, playToEnd, settledCounts } from "../test/support/exampleRun.ts";

/** Growth of the heap after a forced collection, in bytes, that counts as a leak. */
const MAX_GROWTH = 1 << 20;

declare const stage: ExampleStage;

const [name = "", stream = "", frames = "500"] = process.argv.slice(2);
const opened = await openExample(new URL(`../../${name}/test/example.ts`, import.meta.url), { "clip.sgs": stream });
const session = await opened.page.context().newCDPSession(opened.page);
await session.send("HeapProfiler.enable");

async function measured(): Promise<{ heap: number; gpu: Record<string, number> }> {
  const gpu = await settledCounts(opened);
  await session.send("HeapProfiler.collectGarbage");
  const { usedSize } = await session.send("Runtime.getHeapUsage");
  return { heap: usedSize, gpu };
}

await opened.page.evaluate(() => {
  for (const { playback } of stage.clips) playback.playbackRate = 0.1;
});
let first: Awaited<ReturnType<typeof measured>> | undefined;
let last = first;
for (let shown = 0; shown < Number(frames); ) {
  shown += await playToEnd(opened);
  last = await measured();
  console.log(`${shown} frames: heap ${(last.heap / 1e6).toFixed(2)} MB, GPU ${JSON.stringify(last.gpu)}`);
  first ??= last;
}
const leaks = grown(first!.gpu, last!.gpu).length > 0 || last!.heap - first!.heap > MAX_GROWTH;
await opened.page.evaluate(() => stage.removeStreams());
const removed = await measured();
console.log(`removed: heap ${(removed.heap / 1e6).toFixed(2)} MB, GPU ${JSON.stringify(removed.gpu)}`);
console.log(`messages: ${JSON.stringify(opened.complaints)}`);
await opened.close();
process.exitCode = leaks || opened.complaints.length ? 1 : 0;
