"use strict";
/* Runs the page's script against the least of a browser that it needs, and reports what it did.
   Arguments: the script, the data (JSON), and what to do (JSON list of [element, event, fields]). */

const fs = require("fs");
const vm = require("vm");

const [script, dataFile, actions] = process.argv.slice(2);
const text = fs.readFileSync(dataFile, "utf8");
const calls = {};

function context() {
  const state = {};
  return new Proxy({}, {
    get(_, name) {
      if (name in state) return state[name];
      if (name === "measureText") return (t) => ({width: 6 * t.length});
      if (name === "getImageData") {
        return (x, y, w, h) => ({data: new Uint8ClampedArray(4 * w * h).fill(3)});
      }
      if (name === "createImageData") return (w, h) => ({data: new Uint8ClampedArray(4 * w * h)});
      return (...given) => {
        if (given.some((v) => typeof v === "number" && !Number.isFinite(v))) {
          throw new Error(String(name) + " was given " + given);
        }
        calls[name] = (calls[name] || 0) + 1;
      };
    },
    set(_, name, value) {
      state[name] = value;
      return true;
    },
  });
}

class Element {
  constructor() {
    this.children = [];
    this.listeners = {};
    this.style = {};
    this.attributes = {};
    this.classes = new Set();
    this.classList = {
      toggle: (name, on) => (on ? this.classes.add(name) : this.classes.delete(name)),
      add: (name) => this.classes.add(name),
    };
    this.textContent = "";
    this.hidden = true;
    this.offsetWidth = 200;
    this.offsetHeight = 80;
  }

  append(...nodes) { this.children.push(...nodes); }
  addEventListener(name, act) { (this.listeners[name] = this.listeners[name] || []).push(act); }
  setAttribute(name, value) { this.attributes[name] = value; }
  setPointerCapture() {}
  getContext() { return (this.ctx = this.ctx || context()); }
  getBoundingClientRect() { return {left: 0, top: 0, width: 900, height: 700}; }

  fire(name, fields) {
    if (name === "change") this.checked = !this.checked;
    const event = {type: name, pointerId: 1, preventDefault() {}, ...fields};
    (this.listeners[name] || []).forEach((act) => act(event));
  }
}

class Picture extends Element {
  set src(value) {
    this.source = value;
    this.fire("load");
  }
}

const ids = {};
const document = {
  getElementById(id) {
    if (!ids[id]) {
      ids[id] = new Element();
      if (id === "data") ids[id].textContent = text;
    }
    return ids[id];
  },
  createElement() { return new Element(); },
  createTextNode(content) { return {text: content}; },
};
const window = new Element();
window.devicePixelRatio = 2;
const sandbox = {
  document, window, Image: Picture, requestAnimationFrame: (act) => act(),
  ResizeObserver: class { observe() {} }, console,
};
vm.runInNewContext(fs.readFileSync(script, "utf8"), sandbox);

const reports = JSON.parse(actions).map(([target, event, fields]) => {
  const element = target === "window" ? window : target.startsWith("layer:")
    ? ids.layers.children.find((c) => c.children.some((t) => t.text === target.slice(6))).children[0]
    : document.getElementById(target);
  Object.keys(calls).forEach((name) => delete calls[name]);
  element.fire(event, fields || {});
  return {
    tip: ids.tip.hidden ? null : ids.tip.textContent, read: ids.read.textContent, calls: {...calls},
  };
});
const layers = ids.layers.children.flatMap((c) => c.children.map((t) => t.text)).filter(Boolean);
process.stdout.write(JSON.stringify({reports, layers}));
