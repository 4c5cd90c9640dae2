/** Starts and watches `holdfast demo`: its address, its machines' processes, its end. */

import { spawn, spawnSync } from "node:child_process";
import { once } from "node:events";
import { readFileSync } from "node:fs";

/** The address has to be printed within this time. */
export const ADDRESS_WITHIN_MS = 5_000;

export class Demo {
  /** What the demo printed on stdout and stderr, for the report of a failure. */
  output = "";

  constructor(binary, data, listen = "127.0.0.1:0") {
    this.child = spawn(binary, ["demo", "--listen", listen, "--data", data], {
      stdio: ["ignore", "pipe", "pipe"],
    });
    this.ended = once(this.child, "exit").then(([code, signal]) => ({ code, signal }));
    // A binary that cannot be started is told by the one who waits for the address.
    this.ended.catch(() => {});
    for (const stream of [this.child.stdout, this.child.stderr]) {
      stream.on("data", (chunk) => {
        this.output += chunk;
      });
    }
  }

  /** The dashboard's address, once it is printed. */
  async address() {
    const printed = new Promise((resolve) => {
      const look = () => {
        const found = /http:\/\/(127\.0\.0\.1|localhost|\[::1\]):\d+/.exec(this.output);
        if (found !== null) resolve(found[0]);
      };
      this.child.stdout.on("data", look);
      look();
    });
    const early = this.ended.then(
      ({ code, signal }) =>
        Promise.reject(new Error(`the demo ended at once (${code ?? signal}):\n${this.output}`)),
      (error) => Promise.reject(error),
    );
    return withTimeout(
      Promise.race([printed, early]),
      ADDRESS_WITHIN_MS,
      () => `no address within 5 s:\n${this.output}`,
    );
  }

  /** Process ids of the machines, by their configuration's file name. */
  machines() {
    return this.children()
      .map((pid) => ({ pid, words: commandLine(pid) }))
      .filter(({ words }) => words.includes("machine"));
  }

  children() {
    const { stdout } = spawnSync("pgrep", ["-P", String(this.child.pid)], { encoding: "utf8" });
    return stdout.split("\n").filter(Boolean).map(Number);
  }

  /** Ctrl-C; resolves to how the demo ended. */
  async interrupt(within_ms) {
    this.child.kill("SIGINT");
    return withTimeout(this.ended, within_ms, () => `the demo did not end within ${within_ms / 1000} s`);
  }

  /** Whatever happened: nothing is left running. */
  destroy() {
    if (this.child.exitCode !== null || this.child.signalCode !== null) return;
    const children = this.children();
    this.child.kill("SIGKILL");
    for (const pid of children) killQuietly(pid);
  }
}

export function killQuietly(pid) {
  try {
    process.kill(pid, "SIGKILL");
  } catch (error) {
    if (error.code !== "ESRCH") throw error;
  }
}

export async function withTimeout(promise, within_ms, message) {
  let timer;
  const late = new Promise((_, reject) => {
    timer = setTimeout(() => reject(new Error(message())), within_ms);
  });
  try {
    return await Promise.race([promise, late]);
  } finally {
    clearTimeout(timer);
  }
}

function commandLine(pid) {
  try {
    return readFileSync(`/proc/${pid}/cmdline`, "utf8").split("\0");
  } catch {
    return [];
  }
}
