/** Menus close when one turns to something else: a press elsewhere, another view, Escape. */

import { effect } from "@preact/signals";

import { route } from "../route";

const OPEN = "details.menu[open]";

export function closeMenus(): void {
  const closeAll = (except: Element | null) => {
    for (const menu of document.querySelectorAll(OPEN)) if (menu !== except) menu.removeAttribute("open");
  };
  document.addEventListener("click", (event) => {
    closeAll(event.target instanceof Element ? event.target.closest(OPEN) : null);
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    const open = document.activeElement?.closest(OPEN) ?? null;
    closeAll(null);
    // The keyboard stays where the menu was.
    open?.querySelector("summary")?.focus();
  });
  effect(() => {
    void route.value;
    closeAll(null);
  });
}
