// The page around the scene: strip, panes, map, plots with one cursor, and the time that is shown.
"use strict";

const find = (name) => document.getElementById(name);
const POLL_MS = 250;
// without a change nothing is asked more often than this
const IDLE_MS = 1000;
const LIVE_SPAN_S = 120;
const SENSOR_CHARTS = ["rates", "latencies"];
const DEFAULT_CHARTS = ["speed", "heading", "uncertainty", "innovations"];

// names this page's scene among those of others
const BROWSER = Math.random().toString(36).slice(2);
const frame = find("scene").querySelector("iframe");

let state = null;
let isGone = false;

async function fetchJson(path) {
  const response = await fetch(path, { cache: "no-store" });
  if (!response.ok) throw new Error(await response.text());
  return response.json();
}

// --- what this browser remembers

function recall(name, fallback) {
  try { return JSON.parse(localStorage.getItem(`modelserver.${name}`)) ?? fallback; } catch { return fallback; }
}

function remember(name, value) {
  try { localStorage.setItem(`modelserver.${name}`, JSON.stringify(value)); } catch { /* private window */ }
}

// --- light and dark

function setTheme(theme) {
  if (root.dataset.theme === theme) return;
  root.dataset.theme = theme;
  find("theme").textContent = theme === "dark" ? "Light" : "Dark";
  const query = new URLSearchParams(location.search);
  query.delete("token");
  if (theme === "dark") query.set("darkMode", "1");
  frame.src = `/scene/${query.get("fixedDpr") ?? devicePixelRatio}/${BROWSER}?${query}`;
  colorCharts();
  map.paint();
}

// --- the strip

const FIGURES = [
  ["speed", "speed", (value) => `${value.toFixed(2)} m/s`],
  ["heading", "heading", (value) => `${value.toFixed(1)}\u00b0`],
  ["sigma", "sigma", (value) => `${value.toFixed(value < 1 ? 3 : 1)} m`],
  ["level", "protection level", (value) => `${value.toFixed(2)} m`],
];

function formatAge(seconds) {
  if (seconds === null) return "never";
  if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
  return seconds < 120 ? `${seconds.toFixed(1)} s` : `${(seconds / 60).toFixed(0)} min`;
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function fill(list, count, tag, make) {
  while (list.children.length > count) list.lastElementChild.remove();
  while (list.children.length < count) {
    const element = document.createElement(tag);
    make?.(element);
    list.append(element);
  }
}

function showStrip() {
  setText(find("title"), state.title);
  document.title = `${state.title} - ModelServer`;
  const validity = find("validity");
  validity.hidden = !state.has_time;
  const word = state.silence ? "NO SERVICE" : state.valid === null ? "NO POSE" : state.valid ? "VALID" : "INVALID";
  validity.dataset.state = state.silence || state.valid === null ? "none" : state.valid ? "valid" : "invalid";
  setText(validity.firstElementChild, word);
  setText(validity.lastElementChild, state.silence || (state.valid === false ? state.reason : ""));
  const figures = FIGURES.filter(([name]) => Number.isFinite(state[name]));
  fill(find("figures"), figures.length, "div", (each) => each.append(document.createElement("dt"), document.createElement("dd")));
  figures.forEach(([name, label, format], n) => {
    const [term, value] = find("figures").children[n].children;
    setText(term, label);
    setText(value, format(state[name]));
  });
  fill(find("sensors"), state.sensors.length, "li");
  state.sensors.forEach((each, n) => {
    const item = find("sensors").children[n];
    item.className = each.silent ? "silent" : "";
    setText(item, `${each.name} ${formatAge(each.age)}`);
  });
  setText(find("revision"), state.revision);
  find("revision").title = `Revision of the geometry: ${state.revision}`;
}

// --- the frame below the pointer

let hovered = null;
let isHovering = false;

async function showHover() {
  if (isHovering || !hovered) return;
  isHovering = true;
  const asked = hovered;
  const { width, height } = asked.target.getBoundingClientRect();
  const [x, y] = [asked.offsetX / width, asked.offsetY / height];
  const found = await fetchJson(`/hover?${new URLSearchParams({ browser: BROWSER, x, y })}`).catch(() => ({ name: "" }));
  isHovering = false;
  const box = find("hover");
  box.hidden = !found.name || hovered === null;
  if (found.name) {
    setText(box.firstElementChild, found.name);
    setText(box.lastElementChild, found.pose);
    box.style.left = `${Math.min(asked.clientX + 14, width - 60)}px`;
    box.style.top = `${asked.clientY + 14}px`;
  }
  if (hovered !== asked) showHover();
}

frame.addEventListener("load", () => {
  frame.contentDocument.addEventListener("pointermove", (event) => {
    // a drag turns the view
    hovered = event.target.tagName === "CANVAS" && !event.buttons ? event : null;
    if (!hovered) find("hover").hidden = true;
    else showHover();
  });
});
find("scene").addEventListener("pointerleave", () => { hovered = null; find("hover").hidden = true; });

// --- the tree of bodies and frames

let treeOf = null;

async function showTree() {
  if (find("tree").hidden || treeOf === state?.revision) return;
  treeOf = state?.revision;
  const tree = await fetchJson("/tree").catch((error) => { treeOf = null; throw error; });
  const makeCheck = (name, isShown) => {
    const label = document.createElement("label");
    const check = document.createElement("input");
    check.type = "checkbox";
    check.checked = isShown;
    check.name = name;
    check.addEventListener("change", hideUnchecked);
    label.append(check, ` ${name}`);
    return label;
  };
  const [legend] = find("tree").querySelectorAll("legend");
  legend.parentElement.replaceChildren(legend, ...tree.kinds.map((each) => makeCheck(each.name, each.shown)));
  find("tree").querySelector("ul").replaceChildren(...tree.bodies.map((body) => {
    const item = document.createElement("li");
    const frames = document.createElement("ul");
    frames.append(...body.frames.map((name) => {
      const line = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name.slice(body.name.length + 1);
      button.title = `${name}: click for the query, with Shift as its frame of reference`;
      button.dataset.frame = name;
      button.addEventListener("click", (event) => fetchJson(`/pick?${new URLSearchParams({ frame: name, reference: +event.shiftKey })}`));
      line.append(button);
      return line;
    }));
    item.append(makeCheck(body.name, body.shown), frames);
    return item;
  }));
  searchTree();
}

function hideUnchecked() {
  const list = (where) => JSON.stringify([...find("tree").querySelectorAll(`${where} input:not(:checked)`)].map((each) => each.name));
  fetchJson(`/hide?${new URLSearchParams({ bodies: list("ul"), kinds: list("fieldset") })}`);
}

function searchTree() {
  const wanted = find("tree").querySelector("input[type=search]").value.toLowerCase();
  for (const item of find("tree").querySelectorAll(":scope > ul > li")) {
    const isOfBody = item.querySelector("label").textContent.toLowerCase().includes(wanted);
    let count = 0;
    for (const line of item.querySelectorAll("ul > li")) {
      line.hidden = !isOfBody && !line.textContent.toLowerCase().includes(wanted);
      count += !line.hidden;
    }
    item.hidden = !isOfBody && !count;
  }
}

// --- panes

// a link can choose: /#map,plots
const linked = location.hash.slice(1).split(",").filter((each) => find(each));
let panes = linked.length
  ? Object.fromEntries(linked.map((each) => [each, true]))
  : recall("panes", { scene: true, map: false, plots: true });

// sensors alone: all fixes and the rates, where scene, speed and heading would be empty
function showSensors() {
  if (!linked.length) panes = { map: true, plots: true };
  chosen = SENSOR_CHARTS;
  showPanes();
  return seek(state.seconds);
}

function showPanes() {
  const hasTime = state === null || state.has_time;
  if (!panes.scene && !panes.map && !panes.plots) panes.scene = true;
  find("tree").hidden = !panes.tree;
  find("scene").hidden = !panes.scene;
  find("map").hidden = !panes.map || !hasTime;
  find("plots").hidden = !panes.plots || !hasTime;
  document.querySelector("main").hidden = find("tree").hidden && find("scene").hidden && find("map").hidden;
  find("plots").style.flexGrow = document.querySelector("main").hidden ? 1 : "";
  for (const button of document.querySelectorAll("[data-pane]")) {
    button.setAttribute("aria-pressed", panes[button.dataset.pane] ?? false);
    button.hidden = ["map", "plots"].includes(button.dataset.pane) && !hasTime;
  }
  for (const chart of charts) Plotly.Plots.resize(chart);
}

function togglePane(name) {
  panes[name] = !panes[name];
  remember("panes", panes);
  showPanes();
  showTree();
  map.refresh();
  loadCharts();
}

// --- time

const seek = (at) => fetchJson(`/seek?at=${Math.max(at, 0)}`).then(poll);
let isSliding = false;

function showTimeBar() {
  const end = Math.max(state.seconds, 0.1);
  find("slider").max = end;
  if (!isSliding) find("slider").value = state.at;
  const utc = state.utime ? new Date(state.utime / 1000).toISOString().replace("T", " ").replace("Z", "") : "";
  setText(find("clock"), state.begin ? `${state.at.toFixed(2)} s of ${state.seconds.toFixed(1)} s  ${utc}` : "nothing yet");
  setText(find("play"), state.is_playing ? "Pause" : "Play");
  find("live").hidden = !state.is_live;
  find("live").setAttribute("aria-pressed", state.follows);
  for (const chart of charts) showMark(chart, "playhead", state.at);
}

// --- plots

let chosen = recall("charts", DEFAULT_CHARTS);
// the zoomed span, seconds; null shows all, or the last minutes of a live drive
let zoomed = null;
let isDrawing = false;
let drawnEnd = 0;
let library = null;

function loadLibrary() {
  library ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = "/assets/plotly.js";
    script.onload = resolve;
    script.onerror = () => reject(new Error("plotly.js was not loaded"));
    document.head.append(script);
  });
  return library;
}

function getSpan() {
  if (zoomed) return zoomed;
  const end = Math.max(state.seconds, 0.1);
  return [state.is_live ? Math.max(end - LIVE_SPAN_S, 0) : 0, end];
}

let isStaleChart = false;

async function loadCharts() {
  if (find("plots").hidden || !state?.begin) return;
  if (isDrawing) { isStaleChart = true; return; }
  isDrawing = true;
  try {
    await loadLibrary();
    const [from, to] = getSpan();
    drawnEnd = state.seconds;
    const names = chosen.filter((each) => state.charts.includes(each)).join(",");
    const [strip, figures] = await Promise.all([
      fetchJson(`/strip?from=${from}&to=${to}`), fetchJson(`/charts?from=${from}&to=${to}&names=${encodeURIComponent(names)}`),
    ]);
    find("strip").hidden = !state.has_poses;
    if (state.has_poses) await showFigure(find("strip"), strip);
    await showFigure(find("charts"), figures);
    root.dataset.charts = names;
  } catch (error) {
    console.warn(error);
  } finally {
    isDrawing = false;
    if (isStaleChart) { isStaleChart = false; loadCharts(); }
  }
}

async function showFigure(chart, figure) {
  figure.layout.uirevision = "zoom";
  if (charts.includes(chart)) await updateChart(chart, figure);
  else {
    await drawChart(chart, figure);
    addMark(chart, "playhead");
    watchChart(chart);
  }
  showMark(chart, "playhead", state.at);
}

function watchChart(chart) {
  let pressed = null;
  chart.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
  chart.addEventListener("click", (event) => {
    // a drag zooms
    if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 4) return;
    const time = readTime(chart, event);
    if (time !== null) seek(time);
  }, true);
  let waiting = 0;
  chart.on("plotly_relayout", (change) => {
    if (!Object.keys(change).some((key) => key.startsWith("xaxis"))) return;
    const range = chart._fullLayout.xaxis.range;
    zoomed = change["xaxis.autorange"] ? null : [Math.max(range[0], 0), Math.max(range[1], range[0] + 1e-3, 1e-3)];
    clearTimeout(waiting);
    waiting = setTimeout(loadCharts, 150);
  });
  chart.on("plotly_doubleclick", () => { showAll(); return false; });
}

function showAll() {
  zoomed = null;
  loadCharts();
}

function showChoice() {
  const box = find("choice").querySelector("div");
  if (box.dataset.charts === state.charts.join()) return;
  box.dataset.charts = state.charts.join();
  box.replaceChildren(...state.charts.map((name) => {
    const label = document.createElement("label");
    const check = document.createElement("input");
    check.type = "checkbox";
    check.checked = chosen.includes(name);
    check.addEventListener("change", () => {
      chosen = check.checked ? [...chosen, name] : chosen.filter((each) => each !== name);
      remember("charts", chosen);
      loadCharts();
    });
    label.append(check, ` ${name}`);
    return label;
  }));
}

// --- polling

let timer = 0;
let isPolling = false;
let lastState = "";
let lastMap = 0;

const isMoving = () => state?.is_playing || state?.follows;

async function poll() {
  if (isPolling) return;
  isPolling = true;
  clearTimeout(timer);
  try {
    const before = state;
    state = await fetchJson("/state");
    const text = JSON.stringify(state);
    if (!before && state.has_time && !state.is_live && !state.has_poses) showSensors();
    showStrip();
    if (before?.has_time !== state.has_time) showPanes();
    showTree();
    if (state.has_time) {
      showTimeBar();
      showChoice();
      map.setVehicle(state);
      // while time goes on the vehicle moves, and the rest comes more rarely
      if ((text !== lastState && !isMoving()) || Date.now() - lastMap > IDLE_MS) {
        lastMap = Date.now();
        map.refresh();
      }
      if (!charts.length || (!zoomed && state.seconds - drawnEnd >= 1)) loadCharts();
    }
    lastState = text;
    if (isGone) {
      isGone = false;
      find("gone").hidden = true;
      frame.src = frame.src;
    }
  } catch (error) {
    isGone = true;
    find("gone").hidden = false;
    setText(find("gone"), "modelserver view does not answer: it was ended, or its machine cannot be reached. This page comes back with it.");
    console.info(`no answer: ${error}`);
  }
  isPolling = false;
  timer = setTimeout(poll, isGone || !isMoving() || document.hidden ? IDLE_MS : POLL_MS);
}

// --- begin

const map = createMap(find("map"), fetchJson);
setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", (event) => setTheme(event.matches ? "dark" : "light"));
find("theme").addEventListener("click", () => setTheme(root.dataset.theme === "dark" ? "light" : "dark"));
for (const button of document.querySelectorAll("[data-pane]"))
  button.addEventListener("click", () => togglePane(button.dataset.pane));
find("tree").querySelector("input[type=search]").addEventListener("input", searchTree);
find("play").addEventListener("click", () => fetchJson(`/play?on=${state?.is_playing ? 0 : 1}`).then(poll));
find("live").addEventListener("click", () => fetchJson("/live").then(poll));
find("whole").addEventListener("click", showAll);
find("slider").addEventListener("input", () => { isSliding = true; seek(find("slider").value); });
find("slider").addEventListener("change", () => { isSliding = false; });
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
  const pane = { t: "tree", s: "scene", m: "map", p: "plots" }[event.key];
  if (pane) togglePane(pane);
  else if (event.key === " " && state?.has_time) find("play").click();
  else if (event.key === "ArrowLeft" && state?.has_time) seek(state.at - (event.shiftKey ? 10 : 1));
  else if (event.key === "ArrowRight" && state?.has_time) seek(state.at + (event.shiftKey ? 10 : 1));
  else return;
  event.preventDefault();
});
showPanes();
poll();
