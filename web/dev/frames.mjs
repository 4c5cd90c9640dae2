/**
 * How fast the live page draws: `node dev/frames.mjs URL [seconds] [--profile FILE]`. Counts the frames that the
 * browser gives out, and tells the longest pauses and when the first machine could be seen.
 */

import { writeFile } from "node:fs/promises";

import { launch } from "../e2e/browser.mjs";
import { measureFrames, measurePaint } from "../e2e/pace.mjs";

const [url, seconds = "8", , profileFile] = process.argv.slice(2);
const browser = await launch();
const page = await browser.newPage({ viewport: { width: 1440, height: 900 } });
const shown = await measurePaint(page, url);
await page.waitForTimeout(3000);
const session = await page.context().newCDPSession(page);
if (profileFile !== undefined) {
  await session.send("Profiler.enable");
  await session.send("Profiler.start");
}
const frames = await measureFrames(page, Number(seconds));
if (profileFile !== undefined) {
  const { profile } = await session.send("Profiler.stop");
  await writeFile(profileFile, JSON.stringify(profile));
  const self = new Map();
  const step = new Map(profile.nodes.map((node) => [node.id, node.callFrame.functionName || "(anonymous)"]));
  for (const [index, id] of profile.samples.entries()) {
    const name = step.get(id);
    self.set(name, (self.get(name) ?? 0) + (profile.timeDeltas[index] ?? 0));
  }
  const total = [...self.values()].reduce((sum, value) => sum + value, 0);
  for (const [name, time] of [...self].sort((a, b) => b[1] - a[1]).slice(0, 16)) {
    console.log(`${((time / total) * 100).toFixed(1).padStart(6)} %  ${name}`);
  }
}
console.log(JSON.stringify({ ...shown, ...frames }));
await browser.close();
