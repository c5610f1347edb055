/* Undo and redo: a list of {changes, shapes}, of which one is current. `changes` are settings by
   section and key, where null takes a key out of survey.toml; shapes are null as the file has them. */

export const AS_IN_FILE = Object.freeze({changes: {}, shapes: null});
const MOST_STEPS = 500;
const ONE_EDIT_MS = 1000;

export const startHistory = (state = AS_IN_FILE) => ({states: [state], at: 0, tag: "", time: 0});
export const current = (history) => history.states[history.at];
export const canUndo = (history) => history.at > 0;
export const canRedo = (history) => history.at < history.states.length - 1;

/* With a new state after the current one; what was undone is forgotten. Edits of one tag that
   follow within a second are one step: a slider that is dragged, an arrow key held down. */
export function record(history, state, tag = "", time = 0) {
  if (same(state, current(history))) return history;
  const goesOn = tag !== "" && tag === history.tag && time - history.time < ONE_EDIT_MS && history.at > 0;
  const kept = history.states.slice(0, goesOn ? history.at : history.at + 1);
  const states = [...kept, state].slice(-MOST_STEPS);
  return {states, at: states.length - 1, tag, time};
}

export const undo = (history) => ({...history, at: Math.max(0, history.at - 1), tag: ""});
export const redo = (history) => ({...history, at: Math.min(history.states.length - 1, history.at + 1), tag: ""});

/* Equal as JSON values, whatever the order of keys. */
export function same(a, b) {
  if (a === b) return true;
  if (typeof a !== "object" || typeof b !== "object" || a === null || b === null) return false;
  const [keys, others] = [Object.keys(a), Object.keys(b)];
  return Array.isArray(a) === Array.isArray(b) && keys.length === others.length
    && keys.every((key) => key in b && same(a[key], b[key]));
}

/* Changes with one more. `file` holds what survey.toml gives: {settings, written}; a value that
   the file gives already is no change. */
export function withChange(changes, file, section, key, value) {
  const written = (file.written[section] || []).includes(key);
  const asFile = value === null ? !written : same(value, (file.settings[section] || {})[key] ?? null);
  const own = {...changes[section]};
  if (asFile) delete own[key];
  else own[key] = value;
  const {[section]: _, ...others} = changes;
  return Object.keys(own).length ? {...others, [section]: own} : others;
}

/* Changes with all of others, which win. */
export function withChanges(changes, file, more) {
  return Object.entries(more).reduce((all, [section, values]) => Object.entries(values).reduce(
    (some, [key, value]) => withChange(some, file, section, key, value), all,
  ), changes);
}

/* The value of a setting: as changed, else as the file has it; null where it has none. */
export function valueOf(changes, file, section, key) {
  const own = changes[section] || {};
  const value = key in own ? own[key] : (file.settings[section] || {})[key];
  return value ?? null;
}
