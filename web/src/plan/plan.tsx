/** The plan of the site with its buttons, labels, scale and legend. */

import { type ReadonlySignal, type Signal, useComputed, useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useRef } from "preact/hooks";

import type { ShadowCell } from "../api/shadow-map";
import { SeverityIcon } from "../components/icons";
import { type Metres, SiteFrame } from "../geometry/geodesy";
import { type Coordinates, useDesk } from "../store/context";
import { useSpeech } from "../text";
import { useBasemap } from "./basemap";
import { createCanvasView } from "./canvas-view";
import { Legend } from "./legend";
import { type Furniture, PlanPainter } from "./painter";
import { DARK, LIGHT, type Palette } from "./palette";
import { type PlanFeature, planUnderlays, shadowUnderlays } from "./site-plan";
import type { PlanView, Shape } from "./view";

const NO_SHAPES: readonly Shape[] = [];

export interface PlanProps {
  /** The site's own plan. */
  features?: readonly PlanFeature[];
  /** Where GNSS was missing. */
  shadow?: readonly ShadowCell[];
  /** Beside the machines: by the colours in use. */
  extra?: ((palette: Palette) => readonly Shape[]) | undefined;
  /** Buttons of the view that the plan stands in. */
  children?: ComponentChildren;
  /** Once the plan stands. */
  onReady?: ((painter: PlanPainter) => void) | undefined;
}

export function Plan({ features = [], shadow = [], extra, children, onReady }: PlanProps) {
  const { store, choices, recorded } = useDesk();
  const { text } = useSpeech();
  const place = useRef<HTMLDivElement>(null);
  const painter = useSignal<PlanPainter | null>(null);
  const view = useSignal<PlanView | null>(null);
  const measure = useSignal<readonly Metres[] | null>(null);
  const over = useSignal<Metres | null>(null);
  const palette = usePalette();
  const makeExtra = useSignal(extra);
  makeExtra.value = extra;
  const shapes = useComputed(() => makeExtra.value?.(palette.value) ?? NO_SHAPES);

  useEffect(() => {
    const container = place.current;
    if (container === null) return;
    const opened = createCanvasView(container, palette.peek(), text.plan.description, {
      moved: () => painter.peek()?.moved(),
      taken: () => painter.peek()?.taken(),
      over: (at) => {
        over.value = at;
      },
      pressed: (at) => {
        if (measure.peek() !== null) measure.value = [...(measure.peek() ?? []), at];
        else {
          const id = painter.peek()?.machineAt(at) ?? null;
          if (id !== null) choices.selected.value = id;
        }
      },
    });
    view.value = opened;
    const made = new PlanPainter({ store, choices }, opened, palette.peek(), { measure, shapes });
    painter.value = made;
    onReady?.(made);
    return () => {
      made.destroy();
      opened.destroy();
      painter.value = null;
      view.value = null;
    };
  }, [store, text]);

  useEffect(() => palette.subscribe((colours) => painter.peek()?.setPalette(colours)), [palette, painter]);
  useEffect(() => {
    const { underlays, words } = planUnderlays(features, palette.value);
    view.value?.setUnderlays([...shadowUnderlays(shadow, palette.value), ...underlays], words);
  }, [features, shadow, palette.value, view.value]);
  useEffect(() => view.value?.setMeasuring(measure.value !== null), [measure.value, view.value]);

  useEffect(() => {
    if (measure.value === null) return;
    const end = (event: KeyboardEvent) => {
      if (event.key === "Escape") measure.value = null;
    };
    document.addEventListener("keydown", end);
    return () => document.removeEventListener("keydown", end);
  }, [measure.value === null]);

  const basemap = useBasemap(view.value);
  const selected = choices.selected.value;
  const machine = selected === null ? undefined : store.calm.value.machines.get(selected);
  return (
    <section class={`plan${recorded ? " plan-recorded" : ""}`} aria-label={text.plan.title}>
      <div class="plan-canvas" ref={place} />
      {painter.value !== null && (
        <Overlay furniture={painter.value.furniture} onPick={(id) => (choices.selected.value = id)} />
      )}
      <div class="plan-buttons">
        <button type="button" onClick={() => painter.value?.fit()}>
          {text.plan.fit}
        </button>
        <button
          type="button"
          disabled={machine === undefined}
          aria-pressed={choices.following.value}
          title={machine === undefined ? undefined : text.plan.followHint(machine.view.name)}
          onClick={() => (choices.following.value = !choices.following.value)}
        >
          {text.plan.follow}
        </button>
        <button
          type="button"
          class="square"
          aria-label={text.plan.zoomIn}
          onClick={() => painter.value?.zoomBy(2)}
        >
          +
        </button>
        <button
          type="button"
          class="square"
          aria-label={text.plan.zoomOut}
          onClick={() => painter.value?.zoomBy(0.5)}
        >
          −
        </button>
        <button
          type="button"
          aria-pressed={measure.value !== null}
          onClick={() => (measure.value = measure.value === null ? [] : null)}
        >
          {text.plan.measure}
        </button>
        {basemap.exists && (
          <button
            type="button"
            aria-pressed={choices.basemap.value}
            title={text.plan.basemapHint}
            onClick={() => (choices.basemap.value = !choices.basemap.value)}
          >
            {text.plan.basemap}
          </button>
        )}
        {children}
        {basemap.said !== null && (
          <p class="plan-said" role="status" data-said="basemap">
            {basemap.said}
          </p>
        )}
      </div>
      <Legend palette={palette.value} shadow={shadow.length > 0} />
      <Readout measure={measure} over={over} />
      {basemap.attribution !== "" && <p class="plan-attribution">{basemap.attribution}</p>}
    </section>
  );
}

/** Where the pointer is, or what was measured. */
function Readout({
  measure,
  over,
}: {
  measure: ReadonlySignal<readonly Metres[] | null>;
  over: ReadonlySignal<Metres | null>;
}) {
  const { store, choices } = useDesk();
  const { text, format } = useSpeech();
  const points = measure.value;
  if (points !== null) {
    const legs = points.slice(1).map((point, index) => {
      const from = points[index] as Metres;
      return { length_m: Math.hypot(point[0] - from[0], point[1] - from[1]), from, to: point };
    });
    const total_m = legs.reduce((sum, { length_m }) => sum + length_m, 0);
    const last = legs.at(-1);
    return (
      <p class="plan-note plan-measure" role="status">
        {last === undefined
          ? text.plan.measureHint
          : text.plan.measured(
              format.metres(total_m, 2),
              format.bearing(
                (Math.atan2(last.to[0] - last.from[0], last.to[1] - last.from[1]) * 180) / Math.PI,
              ),
            )}
      </p>
    );
  }
  const world = store.calm.value.site?.world;
  if (over.value === null || world === undefined) return null;
  return (
    <p class="plan-note plan-readout" aria-hidden="true">
      {placeText(over.value, choices.coordinates.value, new SiteFrame(world), format, text.plan)}
    </p>
  );
}

/** A place in the coordinates that were chosen. */
export function placeText(
  at: Metres,
  coordinates: Coordinates,
  frame: SiteFrame,
  format: ReturnType<typeof useSpeech>["format"],
  words: { east: string; north: string },
): string {
  if (coordinates === "grid") {
    return `${words.east} ${format.number(at[0], 2)} m, ${words.north} ${format.number(at[1], 2)} m`;
  }
  const [longitude, latitude] = frame.toLngLat(at);
  return `${format.degrees(latitude, 7)}, ${format.degrees(longitude, 7)}`;
}

function Overlay({ furniture, onPick }: { furniture: PlanPainter["furniture"]; onPick(id: string): void }) {
  const { text, format } = useSpeech();
  const { labels, grid, gridStep_m, scale }: Furniture = furniture.value;
  const digits = gridStep_m >= 1 ? 0 : gridStep_m >= 0.1 ? 1 : gridStep_m >= 0.01 ? 2 : 3;
  return (
    <div class="plan-overlay" aria-hidden="true">
      {grid.map(({ along, value_m, offset_px }) => (
        <span
          key={`${along}${value_m.toFixed(3)}`}
          class={`grid-label along-${along}`}
          style={{
            transform: along === "north" ? `translateX(${offset_px}px)` : `translateY(${offset_px}px)`,
          }}
        >
          {along === "north" ? text.plan.east : text.plan.north} {format.number(value_m, digits)}
        </span>
      ))}
      {labels.map((label) => (
        // biome-ignore lint/a11y/noStaticElementInteractions lint/a11y/useKeyWithClickEvents: a shortcut for the mouse; the list holds the buttons.
        <div
          key={label.id}
          class={`label${label.stale ? " stale" : ""}${label.selected ? " selected" : ""}`}
          data-machine={label.id}
          style={{ transform: `translate(${label.x}px, ${label.y}px)` }}
          onClick={() => onPick(label.id)}
        >
          <div class="label-chip">
            <SeverityIcon severity={label.severity} />
            <strong>{label.name}</strong>
            {label.word !== "" && <span class="label-word">{label.word}</span>}
          </div>
        </div>
      ))}
      <div class="north" title={text.plan.northUp}>
        <svg viewBox="0 0 20 28" width="20" height="28" aria-hidden="true">
          <path d="M10 1 17 19 10 15 3 19Z" />
        </svg>
        {text.plan.north}
      </div>
      <div class="scale" title={text.plan.scale}>
        <span>{format.roundLength(scale.length_m)}</span>
        <i style={{ width: `${scale.width_px}px` }} />
      </div>
    </div>
  );
}

/** The palette that the person's system asks for; it follows when that changes. */
function usePalette(): Signal<Palette> {
  const query = useRef(window.matchMedia("(prefers-color-scheme: dark)")).current;
  const palette = useSignal<Palette>(query.matches ? DARK : LIGHT);
  useEffect(() => {
    const follow = () => {
      palette.value = query.matches ? DARK : LIGHT;
    };
    query.addEventListener("change", follow);
    return () => query.removeEventListener("change", follow);
  }, [palette, query]);
  // A change while the page was not drawn has no event in every browser.
  useEffect(() => {
    palette.value = query.matches ? DARK : LIGHT;
  });
  return palette;
}
