import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";

import { poll } from "../src/components/async";

describe("asking again and again", () => {
  beforeEach(() => void vi.useFakeTimers());
  afterEach(() => void vi.useRealTimers());

  it("waits for a slow answer before it asks anew", async () => {
    const answers: (() => void)[] = [];
    const stop = poll(() => new Promise<void>((resolve) => answers.push(resolve)), 2_000);
    await vi.advanceTimersByTimeAsync(20_000);
    expect(answers.length).toBe(1);
    answers[0]?.();
    await vi.advanceTimersByTimeAsync(1_999);
    expect(answers.length).toBe(1);
    await vi.advanceTimersByTimeAsync(1);
    expect(answers.length).toBe(2);
    stop();
  });

  it("tells the step under way that it ends, and takes no other", async () => {
    const signals: AbortSignal[] = [];
    const stop = poll(async (signal) => void signals.push(signal), 1_000);
    await vi.advanceTimersByTimeAsync(1_500);
    stop();
    await vi.advanceTimersByTimeAsync(10_000);
    expect(signals.length).toBe(2);
    expect(signals[1]?.aborted).toBe(true);
  });
});
