/* Scripts of pages: the studio's modules, and the kit's classic scripts that share one scope. */

const browser = [
  "atob", "Blob", "clearInterval", "clearTimeout", "confirm", "console", "createImageBitmap", "CSS",
  "document", "Event", "EventSource", "fetch", "HTMLElement", "Image", "IntersectionObserver", "localStorage",
  "location", "navigator", "requestAnimationFrame", "cancelAnimationFrame", "ResizeObserver",
  "sessionStorage", "setInterval", "setTimeout", "TextDecoder", "URL", "URLSearchParams", "window",
  "AbortController", "FileReader", "performance", "crypto", "structuredClone",
];
const vendored = ["leaflet", "three"];
const shared = ["parse", "Pyramid", "startMap", "startMesh"];
const readable = (names) => Object.fromEntries(names.map((name) => [name, "readonly"]));

const rules = {
  "array-callback-return": "error",
  "consistent-return": "error",
  "eqeqeq": "error",
  "max-len": ["error", {code: 100, ignoreUrls: true}],
  "no-cond-assign": "error",
  "no-const-assign": "error",
  "no-constant-condition": ["error", {checkLoops: false}],
  "no-dupe-args": "error",
  "no-dupe-keys": "error",
  "no-duplicate-imports": "error",
  "no-empty": "error",
  "no-eval": "error",
  "no-fallthrough": "error",
  "no-implied-eval": "error",
  "no-new-func": "error",
  "no-redeclare": ["error", {builtinGlobals: false}],
  "no-self-assign": "error",
  "no-self-compare": "error",
  "no-shadow-restricted-names": "error",
  "no-sparse-arrays": "error",
  "no-throw-literal": "error",
  "no-undef": "error",
  "no-unreachable": "error",
  "no-unused-expressions": ["error", {allowTernary: true, allowShortCircuit: true}],
  "no-unused-vars": ["error", {argsIgnorePattern: "^_$", varsIgnorePattern: "^_$"}],
  "no-use-before-define": ["error", {functions: false, classes: false, variables: false}],
  "no-useless-return": "error",
  "no-var": "error",
  "prefer-const": ["error", {destructuring: "all"}],
  "no-restricted-properties": ["error",
    {property: "innerHTML", message: "Build elements: texts of a workspace may be hostile."},
    {property: "outerHTML", message: "Build elements: texts of a workspace may be hostile."},
    {property: "insertAdjacentHTML", message: "Build elements: texts may be hostile."},
  ],
};

export default [
  {ignores: ["**/vendor_*.js"]},
  {
    files: ["alice_survey/app/studio/web/*.js"],
    languageOptions: {
      ecmaVersion: 2023, sourceType: "module",
      globals: readable([...browser, ...vendored, ...shared]),
    },
    linterOptions: {reportUnusedDisableDirectives: "error"},
    rules,
  },
  {
    files: ["alice_survey/kit/*.js"],
    languageOptions: {
      ecmaVersion: 2023, sourceType: "script",
      globals: readable([...browser, ...vendored, ...shared]),
    },
    rules: {...rules, "no-unused-vars": ["error", {argsIgnorePattern: "^_$", vars: "local"}]},
  },
];
