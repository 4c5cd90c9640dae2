import { defineConfig } from "vite";

// Where `npm run dev` finds a running site: its API is passed on, the page comes from the sources.
const site = process.env.HOLDFAST_SITE ?? "http://127.0.0.1:8080";

export default defineConfig({
  build: {
    target: "es2022",
    // The site's content security policy allows no `data:` fonts or scripts: every asset is its own file.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    // The licences of what is in the bundle go where the bundle goes.
    license: { fileName: "licenses.md" },
    // The map library is one big file by nature, and has a chunk of its own.
    chunkSizeWarningLimit: 1300,
    reportCompressedSize: false,
    rolldownOptions: {
      output: {
        // The map's worker is a module; every server sends `.js` as one.
        assetFileNames: ({ names }) =>
          names.some((name) => name.endsWith(".mjs"))
            ? "assets/[name]-[hash].js"
            : "assets/[name]-[hash][extname]",
      },
    },
  },
  oxc: { jsx: { runtime: "automatic", importSource: "preact" } },
  server: {
    proxy: { "/api": { target: site, ws: true } },
  },
});
