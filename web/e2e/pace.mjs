/** Measures of the page's pace: when something is seen first, and how many frames a second are drawn. */

import { spawn } from "node:child_process";
import { fileURLToPath } from "node:url";

/** Fifty machines at ten views a second each, made up, on the page of the site that runs. */
export async function fiftyMachines(browser, origin) {
  const script = fileURLToPath(new URL("../dev/mock-site.mjs", import.meta.url));
  const child = spawn(process.execPath, [script, "--port", "0", "--machines", "50", "--page", origin], {
    stdio: ["ignore", "pipe", "inherit"],
  });
  try {
    const address = await new Promise((resolve, reject) => {
      let said = "";
      child.stdout.on("data", (chunk) => {
        said += chunk;
        const found = /http:\/\/\S+/.exec(said);
        if (found !== null) resolve(found[0]);
      });
      child.on("exit", () => reject(new Error(`it ended at once: ${said}`)));
    });
    const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
    const page = await context.newPage();
    const shown = await measurePaint(page, address);
    // The first seconds are for the compiler.
    await page.waitForTimeout(2_000);
    const frames = await measureFrames(page, 5);
    await context.close();
    return { ...shown, ...frames };
  } finally {
    child.kill();
  }
}

/** Opens the address; when the first contentful paint was, and the first machine, ms since the navigation began. */
export async function measurePaint(page, url) {
  await page.addInitScript(() => {
    const look = () => {
      if (document.querySelector(".label[data-machine], [data-machine] .state-word") === null) {
        requestAnimationFrame(look);
        return;
      }
      // It is on the screen with the frame after this one.
      requestAnimationFrame(() => {
        window.firstMachine_ms = performance.now();
      });
    };
    requestAnimationFrame(look);
  });
  await page.goto(url);
  await page.waitForFunction(() => window.firstMachine_ms !== undefined, undefined, { timeout: 30_000 });
  return page.evaluate(() => ({
    firstPaint_ms: Math.round(performance.getEntriesByName("first-contentful-paint")[0]?.startTime ?? -1),
    firstMachine_ms: Math.round(window.firstMachine_ms),
  }));
}

/** Frames a second over so many seconds, and the longest pause between two. */
export function measureFrames(page, seconds) {
  return page.evaluate(
    (span_ms) =>
      new Promise((resolve) => {
        const times = [];
        const step = (now_ms) => {
          times.push(now_ms);
          const passed_ms = now_ms - times[0];
          if (passed_ms < span_ms) return requestAnimationFrame(step);
          const pauses = times.slice(1).map((time, index) => time - times[index]);
          pauses.sort((a, b) => a - b);
          resolve({
            fps: Number((((times.length - 1) / passed_ms) * 1000).toFixed(1)),
            longestPause_ms: Math.round(pauses.at(-1)),
            pause95_ms: Math.round(pauses[Math.floor(pauses.length * 0.95)]),
          });
        };
        requestAnimationFrame(step);
      }),
    seconds * 1000,
  );
}
