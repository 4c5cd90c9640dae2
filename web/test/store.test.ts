import { describe, expect, it } from "vitest";

import { healthAge_s, healthIsFresh, isStale, poseAge_s, siteAge_s } from "../src/store/freshness";
import { Store } from "../src/store/store";
import { delta, machineView, poseView, snapshot } from "./views";

/** A store whose clock and frames are driven by the test. */
function bench() {
  const clock = { now_ms: 1000 };
  const frames: (() => void)[] = [];
  const store = new Store({ now: () => clock.now_ms, nextFrame: (callback) => frames.push(callback) });
  const frame = () => {
    for (const callback of frames.splice(0)) callback();
  };
  const open = () => store.setLink({ phase: "open", since_ms: clock.now_ms });
  return { clock, frames, store, frame, open };
}

describe("the store", () => {
  it("writes once per frame, however many messages came", () => {
    const { store, frames, frame } = bench();
    let writes = 0;
    store.state.subscribe(() => {
      writes += 1;
    });
    store.takeSnapshot(snapshot([machineView()]));
    for (let seq = 1; seq <= 50; seq += 1)
      store.takeDelta(delta(seq, [machineView({ state_word: `word ${seq}` })]));
    expect(frames.length).toBe(1);
    expect(writes).toBe(1);
    frame();
    expect(writes).toBe(2);
    expect(store.state.value.machines.get("a")?.view.state_word).toBe("word 50");
  });

  it("forgets machines that are not in a new snapshot", () => {
    const { store, frame } = bench();
    store.takeSnapshot(snapshot([machineView(), machineView({ id: "b" })]));
    frame();
    store.takeSnapshot(snapshot([machineView({ id: "b" })]));
    frame();
    expect([...store.state.value.machines.keys()]).toEqual(["b"]);
  });

  it("does not let deltas from before a snapshot outlive it", () => {
    const { store, frame } = bench();
    store.takeDelta(delta(9, [machineView({ id: "ghost" })]));
    store.takeSnapshot(snapshot([machineView()]));
    frame();
    expect([...store.state.value.machines.keys()]).toEqual(["a"]);
  });

  it("keeps machines that a delta does not name, in the order of their ids", () => {
    const { store, frame } = bench();
    store.takeSnapshot(snapshot([machineView({ id: "c" }), machineView({ id: "a" })]));
    frame();
    store.takeDelta(delta(1, [machineView({ id: "b" })]));
    frame();
    expect([...store.state.value.machines.keys()]).toEqual(["a", "b", "c"]);
  });

  it("lets ages and the site's time grow while nobody speaks", () => {
    const { store, clock, frame, open } = bench();
    open();
    store.takeSnapshot(snapshot([machineView()]));
    frame();
    clock.now_ms += 3000;
    store.tick();
    frame();
    const state = store.state.value;
    const machine = state.machines.get("a");
    if (machine === undefined) throw new Error("the machine is gone");
    expect(poseAge_s(state, machine)).toBeCloseTo(3.05, 9);
    expect(healthAge_s(state, machine)).toBeCloseTo(3.4, 9);
    expect(healthIsFresh(state, machine)).toBe(false);
    expect(siteAge_s(state)).toBeCloseTo(3, 9);
    expect(state.siteTime_ms).toBe(Date.parse("2026-11-23T05:00:03.123Z"));
  });

  it("lets what the site itself counts stay young while it speaks of others", () => {
    const { store, clock, frame } = bench();
    expect(siteAge_s(store.state.value)).toBeNull();
    store.takeSnapshot(snapshot([machineView()]));
    frame();
    clock.now_ms += 3000;
    store.takeDelta(delta(1, []));
    frame();
    const machine = store.state.value.machines.get("a");
    if (machine === undefined) throw new Error("the machine is gone");
    expect(siteAge_s(store.state.value)).toBe(0);
    expect(healthIsFresh(store.state.value, machine)).toBe(false);
  });

  it("draws everything as out of date when the site is lost, without changing the site's words", () => {
    const { store, clock, frame, open } = bench();
    open();
    store.takeSnapshot(snapshot([machineView()]));
    frame();
    const stale = () => {
      const machine = store.state.value.machines.get("a");
      return machine !== undefined && isStale(store.state.value, machine);
    };
    expect(stale()).toBe(false);
    store.setLink({ phase: "lost", since_ms: clock.now_ms, retry_at_ms: clock.now_ms + 250 });
    frame();
    expect(stale()).toBe(true);
    expect(store.state.value.machines.get("a")?.view.state_word).toBe("RTK FIXED");
  });

  it("passes numbers on calmly, but a change of severity at once", () => {
    const { store, clock, frame } = bench();
    store.takeSnapshot(snapshot([machineView()]));
    frame();
    clock.now_ms += 50;
    store.takeDelta(delta(1, [machineView({ pose: poseView({ speed_mps: 1 }) })]));
    frame();
    expect(store.calm.value.machines.get("a")?.view.pose?.speed_mps).toBe(0.4);
    clock.now_ms += 50;
    store.takeDelta(delta(2, [machineView({ severity: "bad" })]));
    frame();
    expect(store.calm.value.machines.get("a")?.view.severity).toBe("bad");
  });

  it("counts messages that cannot be read", () => {
    const { store, frame } = bench();
    store.refuse("first");
    store.refuse("second");
    frame();
    expect(store.state.value.unreadable).toEqual({ count: 2, last: "second" });
  });
});
