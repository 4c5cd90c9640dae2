/** Who is to be named beside a basemap: archives say it in HTML, the page shows plain text. */

const NAMED: Record<string, string> = {
  amp: "&",
  lt: "<",
  gt: ">",
  quot: '"',
  apos: "'",
  nbsp: " ",
  copy: "©",
  reg: "®",
};
const LENGTH_MAX = 300;

/** The words of an archive's attribution; empty if it has none. */
export function attributionOf(metadata: unknown): string {
  const said = (metadata as { attribution?: unknown } | null | undefined)?.attribution;
  return typeof said === "string" ? plainText(said).slice(0, LENGTH_MAX) : "";
}

/** Text of HTML: tags are left out, and the usual names of characters read. It is shown as text all the same. */
export function plainText(html: string): string {
  const words = html.replace(/<(script|style)\b[\s\S]*?<\/\1\s*>/gi, " ").replace(/<[^>]*>/g, "");
  const read = words.replace(/&(#\d{1,7}|#x[0-9a-f]{1,6}|[a-z]+);/gi, (whole, name: string) => {
    if (!name.startsWith("#")) return NAMED[name.toLowerCase()] ?? whole;
    const code = /^#x/i.test(name) ? Number.parseInt(name.slice(2), 16) : Number(name.slice(1));
    return code >= 0x20 && code <= 0x10ffff ? String.fromCodePoint(code) : whole;
  });
  return read.replace(/\s+/g, " ").trim();
}
