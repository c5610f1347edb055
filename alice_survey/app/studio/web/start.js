/* The first start: what shall become of this folder, a survey to plan or a model of pictures. */

import {attempt, button, el, field, mayWrite, say, send, sendNewest} from "./core.js";
import {counted, duration, gigabytes, number} from "./words.js";

const AREA_FILES = ".geojson,.json,.kml,.kmz,.gpx,.gpkg,.zip,.wkt,.csv,.poly";
/* The page of an empty workspace; `started` is called where a job has begun. */
export function startPage(studio, {started, disk, others}) {
  const forms = {plan: planForm(studio.state.workspace), pictures: picturesForm(started, disk)};
  const choose = (name) => {
    Object.entries(forms).forEach(([key, form]) => { form.hidden = key !== name; });
    choices.forEach((one) => one.setAttribute("aria-pressed", String(one.dataset.choice === name)));
    forms[name].querySelector("input, button").focus();
    forms[name].enter?.();
  };
  const choices = [["plan", "Plan a survey"], ["pictures", "I have pictures"]].map(([name, text]) =>
    button(text, () => choose(name), {"data-choice": name, "aria-pressed": "false"}));
  return el("div", {class: "start"},
    el("h2", {}, "What do you want to do?"),
    el("p", {}, el("code", {}, studio.state.workspace),
      others ? " holds no survey yet; what else is in it stays as it is." : " holds nothing yet.",
      " A survey is planned here and flown, in simulation or by a vehicle; or pictures that you "
        + "have become a model of the sea floor."),
    el("div", {class: "buttons choices"}, choices), forms.plan, forms.pictures);
}

const numeric = (attributes) => el("input", {type: "number", step: "any", ...attributes});
const text = (attributes = {}) => el("input", {type: "text", spellcheck: "false",
  autocomplete: "off", ...attributes});
const valueOf = (input) => (input.disabled || input.value.trim() === ""
  ? null : Number(input.value));

/* ---- A survey to plan ---- */

function planForm(workspace) {
  const name = text({required: true, maxlength: 80,
    pattern: "[A-Za-z0-9][A-Za-z0-9 ._\\-]*", value: nameOf(workspace)});
  const latitude = numeric({min: -85, max: 85, placeholder: "32.8236"});
  const longitude = numeric({min: -180, max: 180, placeholder: "34.9553"});
  const depth = numeric({min: 0.1, max: 6000, required: true, value: "15"});
  const along = numeric({min: 0.1, max: 10000, value: "15"});
  const across = numeric({min: 0.1, max: 10000, value: "17"});
  const lens = el("select", {}, el("option", {value: "12.5"}, "12.5 mm: sees 2 m across from 2 m"),
    el("option", {value: "25"}, "25 mm: half as wide, twice as fine"));
  const trial = el("input", {type: "checkbox", onchange: () => {
    [along.value, across.value] = trial.checked ? ["2", "2"] : ["15", "17"];
  }});
  /* A file has the place and the size of the area. */
  const file = el("input", {type: "file", accept: AREA_FILES, onchange: () => {
    const has = file.files.length > 0;
    [latitude, longitude, along, across].forEach((input) => { input.disabled = has; });
  }});
  const make = button("Make the survey", null, {
    class: "primary", type: "submit", disabled: !mayWrite()});

  async function save(event) {
    event.preventDefault();
    make.disabled = true;
    const chosen = file.files[0];
    const made = await attempt(async () => send("/api/start/survey", {
      name: name.value.trim(), seafloor_depth_m: valueOf(depth), focal_mm: Number(lens.value),
      latitude_deg: valueOf(latitude), longitude_deg: valueOf(longitude),
      length_m: valueOf(along), width_m: valueOf(across),
      area: chosen ? {name: chosen.name, base64: await base64(chosen)} : null, trial: trial.checked,
    }));
    make.disabled = false;
    if (!made) return;
    window.location.hash = "plan";
    window.location.reload();
  }

  return el("form", {hidden: true, onsubmit: save},
    el("h2", {}, "Plan a survey"),
    field("Its name", name, "letters, digits and spaces"),
    el("fieldset", {}, el("legend", {}, "Where is it?"),
      el("div", {class: "row"}, field("Latitude, degrees", latitude),
        field("Longitude, degrees", longitude)),
      el("small", {}, "Left empty, it lies at the example's place, off Haifa; all lengths are "
        + "right there too."),
      field("Or a map file", file, "GeoJSON, KML, GPX, GeoPackage, zipped shapefile, WKT or CSV; "
        + "its outline is then the area")),
    field("Depth of the sea floor, m", depth, "about; a chart can be given later"),
    el("div", {class: "field"}, el("label", {}, trial, " A small one, to try the program"),
      el("small", {}, "2 x 2 m, pictures at a sixth of their resolution: from plan to report in "
        + "a few minutes")),
    el("details", {}, el("summary", {}, "Size and camera"),
      el("div", {class: "row"}, field("Length, m", along), field("Width, m", across)),
      el("p", {}, "The area starts as this rectangle; draw it as it is in the Plan tab."),
      field("Lens", lens, "of two 9-megapixel cameras 0.1 m apart behind flat ports; everything "
        + "else of them stands in survey.toml")),
    el("div", {class: "buttons"}, make));
}

const nameOf = (folder) => folder.split(/[\\/]/).at(-1).replace(/[^A-Za-z0-9 ._-]/g, "-").replace(
  /^[^A-Za-z0-9]+/, "") || "survey";

function base64(file) {
  return new Promise((done, fail) => {
    const reader = new FileReader();
    reader.onload = () => done(String(reader.result).replace(/^.*?,/, ""));
    reader.onerror = () => fail(new Error(`${file.name} cannot be read`));
    reader.readAsDataURL(file);
  });
}

/* ---- Pictures that are there ---- */

function picturesForm(started, disk) {
  const path = text();
  const listing = el("ul", {class: "folders"});
  const above = button("Folder above", () => list(above.dataset.path), {disabled: true});
  const files = el("datalist", {id: "start-files"});
  const found = el("div", {class: "found", "aria-live": "polite"});
  const calibration = text({list: "start-files", placeholder: "none"});
  const navigation = text({list: "start-files", placeholder: "none"});
  const zone = text({value: "UTC"});
  const offset = numeric({value: "0"});
  const overlap = numeric({min: 0.3, max: 0.95, value: "0.7"});
  const inside = el("input", {type: "checkbox"});
  const rig = el("fieldset", {hidden: true});
  const take = button("Import them", null, {class: "primary", type: "submit", disabled: true});
  let [here, rigFolders, isRig, asked] = [null, {}, true, 0];

  const questions = el("div", {hidden: true}, rig,
    field("Calibration of the cameras", calibration,
      "a rig.json, if you have calibrated them. Without one the cameras are found from the "
        + "pictures: good for shape, less so for size"),
    field("Navigation", navigation,
      "a CSV with time and position, depth or heading, as import-log writes it. Without one, and "
        + "without GPS in the pictures, the model has no place and no scale: a known length "
        + "gives it one later"),
    el("details", {}, el("summary", {}, "Times, folders inside, videos"),
      field("Time zone of the camera's clock", zone, "such as Europe/Oslo"),
      field("Seconds to add to the pictures' times", offset),
      el("label", {class: "check"}, inside, " also take pictures of folders inside"),
      field("Overlap of neighbouring frames of videos", overlap)),
    el("div", {class: "buttons"}, take));
  path.addEventListener("keydown", (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    list(path.value.trim(), true);
  });
  [calibration, navigation, zone, offset, overlap, inside].forEach(
    (input) => input.addEventListener("change", () => look()));

  async function list(folder, typed = false) {
    const before = path.value;
    const mine = asked += 1;
    const seen = await attempt(() => send("/api/start/folders", {path: folder, typed}));
    if (!seen || mine !== asked || path.value !== before) return;  /* something else is asked now */
    ({here} = seen);
    path.value = here.path;
    above.disabled = !seen.above;
    above.dataset.path = seen.above || "";
    files.replaceChildren(...seen.files.map((value) => el("option", {value})));
    listing.replaceChildren(...(seen.inside.length ? seen.inside.map((one) =>
      el("li", {}, button(one.name, () => list(one.path)), ` ${contentOf(one)}`))
      : [el("li", {}, "no folders inside")]));
    [inside.checked, isRig, rigFolders] = [false, true, {}];
    if (here.pictures + here.videos > 0 || seen.inside.some((one) => one.pictures)) look();
    else {
      take.disabled = questions.hidden = true;
      found.replaceChildren(el("p", {}, "No pictures are in this folder."));
    }
  }

  /* What `import-images` is to be given. */
  function given() {
    const common = {
      rig: calibration.value.trim() || null, navigation: navigation.value.trim() || null,
      time_zone: zone.value.trim() || null, clock_offset: valueOf(offset) || null,
    };
    const cameras = Object.entries(rigFolders).map(([name, place]) => `${name}=${place}`);
    if (cameras.length && isRig) return {...common, camera: cameras};
    if (!cameras.length && !here.pictures && here.videos && !inside.checked) return {
      ...common, video: [here.path], overlap: valueOf(overlap)};
    return {...common, folders: [here.path], recursive: cameras.length > 0 || inside.checked};
  }

  async function look() {
    const mine = asked += 1;
    take.disabled = true;
    found.replaceChildren(el("p", {}, "Looking into the folder …"));
    const seen = await sendNewest("/api/start/preview", given()).catch((fault) => ({fault}));
    if (mine !== asked) return;  /* of another folder, or stopped */
    questions.hidden = false;
    if (seen.fault) {
      found.replaceChildren(el("p", {class: "error"}, seen.fault.message));
      return;
    }
    if (Object.keys(seen.rig_folders).length) {
      rigFolders = seen.rig_folders;
      askRig();
    }
    rig.hidden = !Object.keys(rigFolders).length;
    showFound(seen);
    take.disabled = !mayWrite();
  }

  function askRig() {
    const choice = (value, words) => el("label", {class: "check"}, el("input", {
      type: "radio", name: "start-rig", checked: isRig === value,
      onchange: () => { isRig = value; look(); },
    }), " " + words);
    rig.replaceChildren(
      el("legend", {}, `Folders ${Object.keys(rigFolders).join(", ")} hold equally many pictures`),
      choice(true, "cameras on one rig that were triggered together, such as a stereo pair"),
      choice(false, "one camera, or several that took pictures each for itself"));
  }

  function showFound(seen) {
    const what = [seen.pictures ? counted(seen.pictures, "picture") : "",
      seen.videos ? `${counted(seen.videos, "video")}, ${duration(seen.video_s)}` : ""];
    const times = seen.first_utc
      ? `from ${minuteOf(seen.first_utc)} to ${minuteOf(seen.last_utc)} UTC` : "no times";
    const gps = seen.positions
      ? `GPS in ${Math.round(100 * seen.positions / seen.looked_at)} % of them` : "no GPS";
    const cameras = Object.entries(seen.cameras).map(([name, one]) =>
      `${name} ${one.pictures} pictures` + (one.width_px
        ? ` of ${one.width_px} × ${one.height_px} pixels` : "")
        + (one.device ? ", " + one.device : ""));
    const lines = [...cameras, `${times}, ${gps}`,
      seen.navigation ? `navigation: ${seen.navigation}` : "",
      gigabytes(seen.size_mb) + (seen.pictures ? " are copied"
        : " of videos, of which frames are taken")
        + `; ${number(disk.free_gb, "GB", 3)} are free`];
    found.replaceChildren(
      el("h3", {}, `Found: ${what.filter(Boolean).join(" and ")}`),
      el("ul", {}, lines.filter(Boolean).map((line) => el("li", {}, line))),
      seen.size_mb / 1000 > 0.9 * disk.free_gb ? el("p", {class: "error"},
        "That is more than there is room for: free some of the disk, or start with another "
          + "folder.") : "",
      seen.warnings.length ? el("ul", {class: "warn"},
        seen.warnings.map((line) => el("li", {}, line))) : "");
  }

  async function save(event) {
    event.preventDefault();
    take.disabled = true;
    const begun = await attempt(
      () => send("/api/run/start", {name: "import-images", arguments: given()}));
    take.disabled = false;
    if (!begun) return;
    say("Pictures are being imported");
    await started();
  }

  const form = el("form", {hidden: true, onsubmit: save},
    el("h2", {}, "I have pictures"),
    field("Folder of the pictures", path,
      "type its path, or choose it below; videos are taken too"),
    el("div", {class: "buttons"}, button("Look into it", () => list(path.value.trim(), true)),
      above),
    listing, found, questions, files);
  return Object.assign(form, {enter: () => { if (!here) list(""); }});
}

function contentOf({pictures, videos, folders, more}) {
  const count = (n, one) => (n ? `${n}${more ? "+" : ""} ${one}${n > 1 ? "s" : ""}` : "");
  return [count(pictures, "picture"), count(videos, "video"), count(folders, "folder")]
    .filter(Boolean).join(", ") || "empty";
}

const minuteOf = (utc) => utc.slice(0, 19).replace("T", " ");
