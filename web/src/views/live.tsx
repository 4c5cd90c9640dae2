/** Where every machine is now, and how far that can be trusted. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { fetchShadow, type ShadowCell } from "../api/shadow-map";
import type { ViewProps } from "../app";
import { useAsked } from "../components/async";
import { MachineList } from "../components/machine-list";
import { reasonOf } from "../components/reason";
import { Plan } from "../plan/plan";
import { useSiteFrame } from "../plan/site-frame";
import { fetchPlan, type PlanFeature, putPlan, readPlan } from "../plan/site-plan";
import { useDesk } from "../store/context";
import { mayAdminister } from "../store/people";
import { useSpeech } from "../text";

const SHADOW_REFRESH_MS = 60_000;
const SHADOW_CELL_M = 2;
const NO_CELLS: readonly ShadowCell[] = [];

export default function LiveView(_props: ViewProps) {
  const { choices } = useDesk();
  const { text } = useSpeech();
  const plan = useSitePlan();
  // Where GNSS was missing in the last week.
  const wanted = choices.shadow.value;
  const shadow = useAsked(
    wanted ? "shadow" : "",
    async (signal) => (wanted ? fetchShadow({ cell_m: SHADOW_CELL_M }, signal) : []),
    wanted ? SHADOW_REFRESH_MS : null,
  );
  const said = plan.said ?? (shadow.failure === null ? null : text.plan.shadowFailed(shadow.failure));
  return (
    <>
      <Plan features={plan.features} shadow={shadow.value ?? NO_CELLS}>
        <button
          type="button"
          aria-pressed={choices.shadow.value}
          title={text.plan.shadowHint}
          onClick={() => (choices.shadow.value = !choices.shadow.value)}
        >
          {text.plan.shadow}
        </button>
        {mayAdminister.value && (
          <label class="button file-button">
            {text.plan.upload}
            <input
              type="file"
              class="visually-hidden"
              accept=".geojson,.json,application/geo+json"
              onChange={(event) => {
                const [file] = event.currentTarget.files ?? [];
                event.currentTarget.value = "";
                if (file !== undefined) void plan.upload(file);
              }}
            />
          </label>
        )}
        {said !== null && (
          <p class="plan-said" role="status">
            {said}
          </p>
        )}
      </Plan>
      <div class="side">
        <h1 class="visually-hidden">{text.views.live}</h1>
        <MachineList />
      </div>
    </>
  );
}

/** The site's own plan. */
export function useSitePlan() {
  const { text } = useSpeech();
  const frame = useSiteFrame();
  const features = useSignal<readonly PlanFeature[]>([]);
  const said = useSignal<string | null>(null);
  const fetchNow = async () => {
    if (frame === null) return;
    try {
      features.value = await fetchPlan(frame);
    } catch (error) {
      said.value = text.plan.planFailed(reasonOf(error, text));
    }
  };
  useEffect(() => void fetchNow(), [frame]);
  const upload = async (file: File) => {
    said.value = null;
    try {
      if (frame !== null) readPlan(JSON.parse(await file.text()), frame);
      await putPlan(file);
      await fetchNow();
      said.value = text.plan.uploaded;
    } catch (error) {
      said.value = text.plan.planFailed(reasonOf(error, text));
    }
  };
  return { features: features.value, said: said.value, upload };
}
