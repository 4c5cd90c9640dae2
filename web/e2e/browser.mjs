/** Starts the system's Chromium; nothing is downloaded. */

import { existsSync } from "node:fs";
import { chromium } from "playwright-core";

/** Path of the browser: the environment's CHROMIUM, or Debian's. */
export const CHROMIUM = process.env.CHROMIUM ?? "/usr/bin/chromium";

/** Whether there is a browser to start; if not, says how to get one. */
export function browserMissing() {
  if (existsSync(CHROMIUM)) return null;
  return `no browser at ${CHROMIUM}: install it with "apt-get install chromium", or name another in the environment as CHROMIUM`;
}

export async function launch() {
  const missing = browserMissing();
  if (missing !== null) throw new Error(missing);
  return chromium.launch({
    executablePath: CHROMIUM,
    headless: true,
    args: [
      // As root, as in containers, Chromium runs only without its sandbox; it visits our own page alone.
      "--no-sandbox",
      "--disable-quic",
      "--no-first-run",
      "--disable-background-networking",
      "--disable-component-update",
      "--disable-sync",
    ],
  });
}
