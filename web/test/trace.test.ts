import { describe, expect, it } from "vitest";
import type { GnssState, MachineView } from "../src/api/types";
import { HISTORY_POINTS_MAX, TAIL_POINTS_MAX, TAIL_SPAN_MS, Trace } from "../src/store/trace";
import { machineView, poseView } from "./views";

function at(east_m: number, stamp: number, gnss: GnssState = "fixed"): MachineView {
  const view = machineView({
    pose: poseView({ cabin_position_m: [east_m, 0, 0], stamp: `stamp ${stamp}`, age_s: 0 }),
  });
  if (view.health !== null) view.health.report.gnss = gnss;
  return view;
}

describe("a machine's trace", () => {
  it("keeps a point each time the machine has moved, and none while it stands", () => {
    const trace = new Trace("boot");
    for (let index = 0; index < 13; index += 1) trace.add(at(0.03 * index, index), 100 * index);
    expect(trace.tail.map((point) => point.at[0])).toEqual([0, 0.12, 0.24, 0.36]);
  });

  it("marks where the state of the fixes changed", () => {
    const trace = new Trace("boot");
    trace.add(at(0, 1), 0);
    trace.add(at(0.01, 2, "silent"), 100);
    expect(trace.tail.map((point) => point.gnss)).toEqual(["fixed", "silent"]);
    expect(trace.tail.map((point) => point.starts)).toEqual([true, false]);
  });

  it("does not join what it was not told about", () => {
    const trace = new Trace("boot");
    trace.add(at(0, 1), 0);
    trace.add(at(5, 2), 10_000);
    trace.interrupt();
    trace.add(at(6, 3), 10_100);
    expect(trace.tail.map((point) => point.starts)).toEqual([true, true, true]);
  });

  it("goes on from where the site says that the machine was before, and no further back than a tail", () => {
    const trace = new Trace("boot");
    trace.add(at(10, 1, "silent"), 400_000);
    trace.add(at(11, 2, "silent"), 400_100);
    const earlier = (east_m: number, time_ms: number, gnss: GnssState) => ({
      at: [east_m, 0] as const satisfies readonly [number, number],
      time_ms,
      gnss,
    });
    trace.precede([
      earlier(1, 99_000, "fixed"),
      earlier(7, 397_000, "fixed"),
      earlier(7.02, 398_000, "fixed"),
      earlier(8, 399_000, "silent"),
      earlier(99, 400_000, "silent"),
    ]);
    expect(trace.tail.map((point) => point.at[0])).toEqual([7, 8, 10, 11]);
    expect(trace.tail.map((point) => point.starts)).toEqual([true, false, false, false]);
  });

  it("does not join what lies too long before", () => {
    const trace = new Trace("boot");
    trace.add(at(10, 1), 400_000);
    trace.precede([{ at: [7, 0], time_ms: 390_000, gnss: "fixed" }]);
    expect(trace.tail.map((point) => point.starts)).toEqual([true, true]);
  });

  it("takes the same pose once", () => {
    const trace = new Trace("boot");
    trace.add(at(0, 1), 0);
    trace.add(at(0, 1), 500);
    expect(trace.history.length).toBe(1);
  });

  it("is bounded in time and in number", () => {
    const trace = new Trace("boot");
    for (let index = 0; index < 20_000; index += 1) trace.add(at(index, index), 100 * index);
    expect(trace.tail.length).toBeLessThanOrEqual(TAIL_POINTS_MAX);
    expect(trace.history.length).toBeLessThanOrEqual(HISTORY_POINTS_MAX);
    const first = trace.tail[0]?.time_ms ?? Number.NaN;
    expect(100 * 19_999 - first).toBeLessThanOrEqual(TAIL_SPAN_MS);
  });
});
