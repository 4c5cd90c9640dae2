/** Who sits at the page, and what they may do. A site without accounts lets everybody do everything. */

import { computed, type ReadonlySignal, signal } from "@preact/signals";

import type { Me, Role } from "../api/accounts";

/** `null` as long as the site has not said; `"nobody"` if one has to sign in first. */
const current = signal<Me | "nobody" | null>(null);

export const me: ReadonlySignal<Me | "nobody" | null> = current;

export function setMe(value: Me | "nobody" | null): void {
  current.value = value;
}

const RANKS: Record<Role, number> = { viewer: 0, operator: 1, admin: 2 };

function atLeast(role: Role): boolean {
  const known = current.value;
  return known !== null && known !== "nobody" && RANKS[known.role] >= RANKS[role];
}

/** Whether one may acknowledge, write notes, start and stop recordings. */
export const mayOperate = computed(() => atLeast("operator"));
/** Whether one may change accounts and the site's plan. */
export const mayAdminister = computed(() => atLeast("admin"));
