/** What is left of the site's tolerance while a machine holds its position by itself. */

import { paths } from "../route";
import { healthAge_s, healthIsFresh, SITE_FRESH_S, siteAge_s } from "../store/freshness";
import type { Machine, State } from "../store/store";
import { useSpeech } from "../text";

export function BudgetLine({ machine, state }: { machine: Machine; state: State }) {
  const { text, format } = useSpeech();
  const { outage } = machine.view.gnss;
  if (outage === null) return null;
  // That it lasts is the site's word; what is left is reckoned from what the machine says.
  const told_s = siteAge_s(state) ?? 0;
  const stale = told_s > SITE_FRESH_S;
  const spent = !stale && outage.budget !== null && !healthIsFresh(state, machine);
  const { budget } = outage;
  const words: string[] = [];
  if (budget !== null) {
    const { tolerance_m, time_s, distance_m } = budget;
    if (time_s === 0 || distance_m === 0) words.push(text.budget.passed(format.smallLength(tolerance_m)));
    else {
      const left = [
        ...(time_s === null ? [] : [format.span(time_s)]),
        ...(distance_m === null ? [] : [format.metres(distance_m, 1)]),
      ];
      words.push(
        left.length === 0
          ? text.budget.steady(format.smallLength(tolerance_m))
          : text.budget.left(left.join(text.budget.or), format.smallLength(tolerance_m)),
      );
    }
  } else words.push(text.budget.early);
  const is_over = budget !== null && (budget.time_s === 0 || budget.distance_m === 0);
  return (
    <p class={`budget${is_over ? " budget-over" : ""}${stale || spent ? " stale" : ""}`}>
      {stale && <b>{text.budget.asOf(format.age(told_s))} </b>}
      {text.budget.outage(text.fix[outage.cause], format.span(outage.duration_s))}{" "}
      {spent && <b>{text.budget.asOf(format.age(healthAge_s(state, machine)))} </b>}
      {words.join(" ")} <a href={paths.outage(outage.id)}>{text.budget.details}</a>
    </p>
  );
}
