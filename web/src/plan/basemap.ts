/**
 * The site's basemap under a plan. Whether there is one is asked once; the part of the page that reads and draws it is
 * loaded when it is first shown, and nothing is asked for while it is not.
 */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { fetchMap, type SiteMap } from "../api/map";
import type { OpenBasemap } from "../basemap";
import { reasonOf } from "../components/reason";
import { useDesk } from "../store/context";
import { useSpeech } from "../text";
import { useSiteFrame } from "./site-frame";
import type { PlanView } from "./view";

const known = signal<SiteMap | null>(null);
const opened = signal<OpenBasemap | null>(null);
/** Why there is nothing to show. */
const failure = signal<unknown>(null);
let asking = false;

/** One step at a time: is there one, then open it. Another plan tries again what failed. */
async function proceed(shown: boolean): Promise<void> {
  if (asking || opened.peek() !== null) return;
  asking = true;
  try {
    known.value ??= await fetchMap();
    const { basemap } = known.value;
    if (basemap !== null && shown) {
      const { openBasemap } = await import("../basemap");
      opened.value = await openBasemap(basemap.attribution);
    }
    failure.value = null;
  } catch (error) {
    failure.value = error;
  } finally {
    asking = false;
  }
}

export interface Shown {
  /** Whether the site has one. */
  exists: boolean;
  /** Who is to be named beside what is drawn; empty for nobody. */
  attribution: string;
  /** What is wrong with it, in words. */
  said: string | null;
}

/** Draws the basemap on a plan, if the site has one and the person wants it. */
export function useBasemap(view: PlanView | null): Shown {
  const { choices } = useDesk();
  const { text } = useSpeech();
  const frame = useSiteFrame();
  const wanted = choices.basemap.value;
  const basemap = opened.value;
  useEffect(() => void proceed(wanted), [wanted, known.value]);
  useEffect(() => {
    if (view === null || frame === null || basemap === null || !wanted) return;
    const layer = basemap.layer(frame, () => view.redraw());
    view.setBackdrop(layer);
    return () => {
      view.setBackdrop(null);
      layer.destroy();
    };
  }, [view, frame, basemap, wanted]);
  const wrong = failure.value ?? basemap?.failure.value ?? null;
  return {
    exists: known.value !== null && known.value.basemap !== null,
    attribution: wanted ? (basemap?.attribution ?? "") : "",
    said: wanted && wrong !== null ? text.plan.basemapFailed(reasonOf(wrong, text)) : null,
  };
}
