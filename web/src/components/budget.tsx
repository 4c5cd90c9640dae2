/** What is left of the site's tolerance while a machine holds its position by itself. */

import type { GnssView } from "../api/types";
import { paths } from "../route";
import { useSpeech } from "../text";

export function BudgetLine({ gnss }: { gnss: GnssView }) {
  const { text, format } = useSpeech();
  const { outage } = gnss;
  if (outage === null) return null;
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
    <p class={`budget${is_over ? " budget-over" : ""}`}>
      {text.budget.outage(text.fix[outage.cause], format.span(outage.duration_s))} {words.join(" ")}{" "}
      <a href={paths.outage(outage.id)}>{text.budget.details}</a>
    </p>
  );
}
