/** Measures of the page's pace: when something is seen first, and how many frames a second are drawn. */

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
