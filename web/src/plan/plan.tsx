/** The plan of the site with its buttons, labels, scale and legend. */

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { SeverityIcon } from "../components/icons";
import { SiteFrame } from "../geometry/geodesy";
import { useDesk } from "../store/context";
import { useSpeech } from "../text";
import { Legend } from "./legend";
import { type Furniture, PlanPainter } from "./painter";
import { DARK, LIGHT, type Palette } from "./palette";
import { createSvgView } from "./svg-view";
import type { PlanEvents, PlanView } from "./view";

type Drawing = "waiting" | "map" | "simple";

export function Plan() {
  const { store, choices } = useDesk();
  const { text } = useSpeech();
  const canvas = useRef<HTMLDivElement>(null);
  const painter = useSignal<PlanPainter | null>(null);
  const drawing = useSignal<Drawing>("waiting");
  const palette = usePalette();
  const world = store.calm.value.site?.world ?? null;
  const worldKey = world === null ? null : `${world.latitude_deg} ${world.longitude_deg} ${world.altitude_m}`;

  // The plan is built once for each world origin; colours follow below.
  useEffect(() => {
    if (world === null || canvas.current === null) return;
    const container = canvas.current;
    const frame = new SiteFrame(world);
    let gone = false;
    let view: PlanView | null = null;
    const close = () => {
      painter.value?.destroy();
      painter.value = null;
      view?.destroy();
      view = null;
    };
    const events: PlanEvents = {
      moved: () => painter.value?.moved(),
      taken: () => painter.value?.taken(),
      failed: () => {
        if (gone) return;
        close();
        openSimple();
      },
    };
    const show = (opened: PlanView, as: Drawing) => {
      view = opened;
      painter.value = new PlanPainter({ store, choices }, opened, palette.value);
      drawing.value = as;
    };
    const openSimple = () =>
      show(createSvgView(container, palette.value, text.plan.description, events), "simple");
    const open = async () => {
      if (!webglWorks()) return openSimple();
      try {
        const { createMapView } = await import("./map-view");
        if (gone) return;
        show(createMapView(container, frame, palette.value, text.plan.description, events), "map");
      } catch {
        if (!gone) openSimple();
      }
    };
    void open();
    return () => {
      gone = true;
      close();
    };
  }, [worldKey]);

  useEffect(() => palette.subscribe((colours) => painter.value?.setPalette(colours)), [palette, painter]);

  const selected = choices.selected.value;
  const machine = selected === null ? undefined : store.calm.value.machines.get(selected);
  return (
    <section class="plan" aria-label={text.plan.title} data-drawing={drawing.value}>
      <div class="plan-canvas" ref={canvas} />
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
      </div>
      <Legend palette={palette.value} />
      {drawing.value === "simple" && <p class="plan-note">{text.plan.simple}</p>}
    </section>
  );
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
          {along === "north" ? "E" : "N"} {format.number(value_m, digits)}
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
            <span class="label-word">{label.word}</span>
          </div>
        </div>
      ))}
      <div class="north" title={text.plan.north}>
        <svg viewBox="0 0 20 28" width="20" height="28" aria-hidden="true">
          <path d="M10 1 17 19 10 15 3 19Z" />
        </svg>
        N
      </div>
      <div class="scale" title={text.plan.scale}>
        <span>{format.roundLength(scale.length_m)}</span>
        <i style={{ width: `${scale.width_px}px` }} />
      </div>
    </div>
  );
}

/** The palette that the person's system asks for; it follows when that changes. */
function usePalette() {
  const query = useRef(window.matchMedia("(prefers-color-scheme: dark)")).current;
  const palette = useSignal<Palette>(query.matches ? DARK : LIGHT);
  useEffect(() => {
    const follow = () => {
      palette.value = query.matches ? DARK : LIGHT;
    };
    query.addEventListener("change", follow);
    return () => query.removeEventListener("change", follow);
  }, [palette, query]);
  return palette;
}

/** Whether the map can draw here; `?plan=simple` asks for the plain plan. */
function webglWorks(): boolean {
  if (new URLSearchParams(window.location.search).get("plan") === "simple") return false;
  const context = document.createElement("canvas").getContext("webgl2");
  if (context === null) return false;
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return true;
}
