import { gzipSync } from "node:zlib";
import { defineConfig, type Plugin } from "vite";

// Where `npm run dev` finds a running site: its API is passed on, the page comes from the sources.
const site = process.env.HOLDFAST_SITE ?? "http://127.0.0.1:8080";

/** All of the page, compressed: a site office's link may be thin. */
const BUNDLE_MAX_BYTES = 500_000;

/** Fails the build when the page has become too big. */
function weigh(): Plugin {
  return {
    name: "weigh",
    generateBundle(_options, bundle) {
      const sizes = Object.values(bundle).map(
        (file) => gzipSync(file.type === "chunk" ? file.code : file.source).length,
      );
      const bytes = sizes.reduce((sum, size) => sum + size, 0);
      if (bytes > BUNDLE_MAX_BYTES) {
        this.error(`the page has ${bytes} bytes compressed, must have ${BUNDLE_MAX_BYTES} at most`);
      }
    },
  };
}

export default defineConfig({
  plugins: [weigh()],
  build: {
    target: "es2022",
    // The site's content security policy allows no `data:` fonts or scripts: every asset is its own file.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    // The licences of what is in the bundle go where the bundle goes.
    license: { fileName: "licenses.md" },
    reportCompressedSize: false,
    rolldownOptions: {
      output: {
        // The plan and the plots come with the views that show them.
        codeSplitting: {
          groups: [
            { name: "plan", test: /src\/(plan|geometry)\// },
            { name: "plots", test: /uplot/ },
          ],
        },
      },
    },
  },
  oxc: { jsx: { runtime: "automatic", importSource: "preact" } },
  server: {
    proxy: { "/api": { target: site, ws: true } },
  },
});
