/** One value with its name and its age; when it is old, it looks old. */

import type { ComponentChildren } from "preact";

import { useSpeech } from "../text";

export interface FieldProps {
  name: string;
  children: ComponentChildren;
  /** `null` when there is no value yet; `undefined` when the value has no age of its own. */
  age_s?: number | null | undefined;
  /** Older than this, it is out of date. */
  fresh_s?: number;
  hint?: string | undefined;
}

export function Field({ name, children, age_s, fresh_s = Number.POSITIVE_INFINITY, hint }: FieldProps) {
  const { text, format } = useSpeech();
  const stale = age_s != null && age_s > fresh_s;
  return (
    <div class={`field${stale ? " stale" : ""}`} title={hint}>
      <dt>{name}</dt>
      <dd>
        <span class="value">{children}</span>
        {age_s !== undefined && (
          <span class="age">
            {age_s === null ? text.fields.unknown : text.fields.age(format.age(age_s))}
            {stale && <span class="visually-hidden"> ({text.fields.stale})</span>}
          </span>
        )}
      </dd>
    </div>
  );
}
