/** For a field that a person has just asked for: the keyboard is in it when it appears. */
const seen = new WeakSet<HTMLElement>();

export function focusOnce(field: HTMLElement | null): void {
  if (field === null || seen.has(field)) return;
  seen.add(field);
  field.focus();
}
