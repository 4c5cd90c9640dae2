import { describe, expect, it } from "vitest";
import type { GnssState, MachineView } from "../src/api/types";
import { LIGHT } from "../src/plan/palette";
import { buildShapes, machinesExtent, RING_RADIUS_PX } from "../src/plan/scene";
import type { Machine, State } from "../src/store/store";
import { Trace } from "../src/store/trace";
import { machineView, poseView, WORLD } from "./views";

function stateOf(view: MachineView, trace = new Trace(view.boot)): State {
  const machine: Machine = { view, received_ms: 0, trace };
  return {
    now_ms: 0,
    link: { phase: "open", since_ms: 0 },
    site: { id: "site", name: "Site", time_zone: "UTC", world: WORLD, software: "0" },
    siteTime_ms: 0,
    told_ms: 0,
    machines: new Map([[view.id, machine]]),
    unreadable: { count: 0, last: null },
  };
}

const options = { palette: LIGHT, metresPerPixel: 0.02, selected: null };

describe("the plan's shapes", () => {
  it("draw chassis and cabin with separate directions", () => {
    // The cabin looks east, the chassis north.
    const shapes = buildShapes(stateOf(machineView()), options);
    const reach = (layer: string) => {
      const points = shapes.filter((shape) => shape.layer === layer).flatMap((shape) => shape.points);
      return [Math.max(...points.map(([x]) => x - 10)), Math.max(...points.map(([, y]) => y - 4))];
    };
    expect(reach("cabin")[0]).toBeCloseTo(6.3, 9);
    expect(reach("chassis")[1]).toBeCloseTo(2.45, 9);
    expect(reach("chassis")[0]).toBeCloseTo(1.3, 9);
  });

  it("leave the chassis out where its direction is not known", () => {
    const view = machineView({ pose: poseView({ chassis_heading_deg: null, chassis_position_m: null }) });
    expect(buildShapes(stateOf(view), options).some((shape) => shape.layer === "chassis")).toBe(false);
  });

  it("ring a small ellipse so that it is seen, and not a large one", () => {
    const rings = (semi_major_m: number) => {
      const ellipse95 = { semi_major_m, semi_minor_m: 0.01, bearing_deg: 0 };
      const shapes = buildShapes(stateOf(machineView({ pose: poseView({ ellipse95 }) })), options);
      expect(shapes.filter((shape) => shape.layer === "ellipse").length).toBe(1);
      return shapes.filter((shape) => shape.layer === "ring");
    };
    const [ring] = rings(0.02);
    const [x = 0, y = 0] = ring?.points[0] ?? [];
    expect(Math.hypot(x - 10.5, y - 4)).toBeCloseTo(RING_RADIUS_PX * options.metresPerPixel, 9);
    expect(rings(1.0).length).toBe(0);
  });

  it("fade and hatch a machine that the site calls lost", () => {
    const shapes = buildShapes(stateOf(machineView({ presence: "lost", severity: "offline" })), options);
    expect(shapes.some((shape) => shape.layer === "hatch")).toBe(true);
    expect(
      shapes.filter((shape) => shape.layer === "cabin").every((shape) => (shape.fillOpacity ?? 1) < 0.5),
    ).toBe(true);
  });

  it("colour the tail by the state of the fixes at the time", () => {
    const trace = new Trace("boot");
    const walk: GnssState[] = ["fixed", "fixed", "silent", "silent", "fixed"];
    walk.forEach((gnss, index) => {
      const view = machineView({
        pose: poseView({ stamp: `${index}`, cabin_position_m: [index, 0, 0], age_s: 0 }),
      });
      if (view.health !== null) view.health.report.gnss = gnss;
      trace.add(view, index * 100);
    });
    const view = machineView({ pose: poseView({ cabin_position_m: [4.5, 0, 0] }) });
    const lines = buildShapes(stateOf(view, trace), options).filter((shape) => shape.layer === "tail");
    expect(lines.map((line) => line.stroke)).toEqual([LIGHT.gnss.fixed, LIGHT.gnss.silent, LIGHT.gnss.fixed]);
    expect(lines.map((line) => line.points.map(([x]) => x))).toEqual([
      [0, 1, 2],
      [2, 3, 4],
      [4, 4.5],
    ]);
  });

  it("show nothing of a machine without a pose", () => {
    const state = stateOf(machineView({ pose: null }));
    expect(buildShapes(state, options)).toEqual([]);
    expect(machinesExtent(state.machines.values())).toBeNull();
  });
});
