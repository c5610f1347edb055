/* What is changed of a plan: {changes, shapes}. `changes` are settings by section and key, where
   null takes a key out of survey.toml; shapes are null as the file has them. */

import {same} from "./undo.js";

export const AS_IN_FILE = Object.freeze({changes: {}, shapes: null});

/* Changes with one more. `file` holds what survey.toml gives: {settings, written}; a value that
   the file gives already is no change. */
export function withChange(changes, file, section, key, value) {
  const written = (file.written[section] || []).includes(key);
  const asFile = value === null ? !written : same(value, (file.settings[section] || {})[key]
    ?? null);
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
