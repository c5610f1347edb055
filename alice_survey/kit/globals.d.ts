/* What vendor_map.js, vendor_mesh.js and the kit's classic scripts put into the global scope. */
declare const leaflet: any;
declare const three: any;

/* Elements are found by selectors that say what they are. */
interface Element {
  checked: any;
  readonly dataset: DOMStringMap;
  open: any;
  tabIndex: number;
  value: any;
  click(): void;
  focus(options?: FocusOptions): void;
}
interface EventTarget {
  closest: any;
  id: any;
}
