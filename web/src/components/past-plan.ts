/** What a plan of the past needs: a desk without machines, and where to look. */

import { signal } from "@preact/signals";
import { useMemo } from "preact/hooks";

import type { Metres } from "../geometry/geodesy";
import type { Extent } from "../geometry/grid";
import { type Choices, type Desk, type Source, useDesk } from "../store/context";
import type { State } from "../store/store";

/** Around what a plan is to show. */
const ROOM_M = 6;

/** What holds all the points, with a little room; `null` without any. */
export function extentOf(points: readonly Metres[]): Extent | null {
  if (points.length === 0) return null;
  const most = (sign: 1 | -1, axis: 0 | 1) =>
    points.reduce((found, point) => Math.max(found, sign * point[axis]), Number.NEGATIVE_INFINITY) + ROOM_M;
  return { min: [-most(-1, 0), -most(-1, 1)], max: [most(1, 0), most(1, 1)] };
}

/** A desk whose picture has no machines: the plan of what was. */
export function useEmptyDesk(): Desk {
  const desk = useDesk();
  return useMemo(() => {
    const empty = signal<State>({ ...desk.store.calm.peek(), machines: new Map() });
    const source: Source = { state: empty, calm: empty };
    const choices: Choices = { ...desk.choices, selected: signal(null), following: signal(false) };
    return { store: source, choices, recorded: true };
  }, [desk.store.calm.value.site === null]);
}

/** Names of machines by their ids. */
export function useNames(): Map<string, string> {
  const { store } = useDesk();
  return new Map([...store.calm.value.machines].map(([id, { view }]) => [id, view.name]));
}
