/** Counts checks; each has a name that says what must hold. */

export class Checks {
  passed = 0;
  failed = 0;

  /** Runs one check: it fails if it throws or comes to `false`. The ones after it go on. */
  async check(name, run) {
    const start = performance.now();
    try {
      if ((await run()) === false) throw new Error("it does not hold");
      this.passed += 1;
      console.log(`ok      ${name} (${((performance.now() - start) / 1000).toFixed(1)} s)`);
      return true;
    } catch (error) {
      this.failed += 1;
      console.log(
        `FAILED  ${name}\n        ${String(error.message ?? error).replaceAll("\n", "\n        ")}`,
      );
      return false;
    }
  }

  close() {
    console.log(`${this.passed} passed, ${this.failed} failed`);
    return this.failed === 0 && this.passed > 0 ? 0 : 1;
  }
}
