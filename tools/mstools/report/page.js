// Draw the charts of a report: one time on all of them, one zoom of all time axes, light and dark.
"use strict";

const root = document.documentElement;
const charts = [...document.querySelectorAll(".chart")];
const isOverTime = (chart) => chart.hasAttribute("data-time");
// the buttons are listed: among plotly's own is one that sends a chart to a server
const CONFIG = {
  responsive: true, displaylogo: false, plotlyServerURL: "",
  modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
};

// --- light and dark

function readColor(name) {
  return getComputedStyle(root).getPropertyValue(name).trim();
}

function makeColors(layout) {
  const changes = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: readColor("--wash"), "font.color": readColor("--ink"),
    "hoverlabel.bgcolor": readColor("--paper"), "hoverlabel.font.color": readColor("--ink"),
  };
  for (const key of Object.keys(layout).filter((name) => /^[xy]axis/.test(name)))
    for (const part of ["gridcolor", "linecolor", "zerolinecolor"]) changes[`${key}.${part}`] = readColor("--line");
  return changes;
}

function setTheme(theme) {
  root.dataset.theme = theme;
  document.getElementById("theme").textContent = theme === "dark" ? "Light" : "Dark";
  for (const chart of charts) if (chart.layout) Plotly.relayout(chart, makeColors(chart.layout));
}

// --- one time on all charts

function addMark(chart, name) {
  const mark = document.createElement("div");
  mark.className = name;
  chart.append(mark);
  return mark;
}

function showCursor(chart, time) {
  const axis = chart._fullLayout.xaxis;
  const size = chart._fullLayout._size;
  const at = axis.l2p(time);
  const mark = chart.querySelector(".cursor");
  const isInside = at >= 0 && at <= axis._length;
  Object.assign(mark.style, {
    display: isInside ? "block" : "none", left: `${size.l + at}px`, top: `${size.t}px`, height: `${size.h}px`,
  });
}

function findPlace(chart, time) {
  let best = null;
  for (const trace of chart._fullData) {
    if (!trace.customdata || trace.mode !== "lines") continue;
    trace.customdata.forEach((each, number) => {
      if (each === null) return;
      const distance = Math.abs(each - time);
      if (best === null || distance < best.distance) best = { distance, x: trace.x[number], y: trace.y[number] };
    });
  }
  return best;
}

function showSpot(chart, time) {
  const place = findPlace(chart, time);
  if (place === null) return;
  const { xaxis, yaxis } = chart._fullLayout;
  Object.assign(chart.querySelector(".spot").style, {
    display: "block", left: `${xaxis._offset + xaxis.l2p(place.x)}px`, top: `${yaxis._offset + yaxis.l2p(place.y)}px`,
  });
}

function showTime(time) {
  root.dataset.time = time;
  for (const chart of charts) {
    if (!chart._fullLayout) continue;
    if (isOverTime(chart)) showCursor(chart, time);
    else showSpot(chart, time);
  }
}

// the pointer's time: plotly's own hover events are of drawn points, and there is none between two bars
function followPointer(chart) {
  let last = null;
  chart.addEventListener("mousemove", (event) => {
    if (last === null) requestAnimationFrame(() => {
      const at = last.clientX - chart.getBoundingClientRect().left - chart._fullLayout._size.l;
      const axis = chart._fullLayout.xaxis;
      last = null;
      if (at >= 0 && at <= axis._length) showTime(axis.p2l(at));
    });
    last = event;
  });
}

function followPoints(chart) {
  chart.on("plotly_hover", (event) => {
    const time = event.points[0].customdata ?? null;
    if (time !== null) showTime(time);
  });
}

// --- one zoom of all time axes

let isLinking = false;

async function linkZoom(source, change) {
  if (isLinking || !Object.keys(change).some((key) => key.startsWith("xaxis"))) return;
  isLinking = true;
  const range = [...source._fullLayout.xaxis.range];
  const others = charts.filter((chart) => chart !== source && isOverTime(chart) && chart._fullLayout);
  await Promise.all(others.map((chart) => Plotly.relayout(chart, { "xaxis.range": range })));
  isLinking = false;
}

// --- drawing

async function loadLibrary() {
  const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

async function draw(chart) {
  const figure = JSON.parse(chart.firstElementChild.textContent);
  await Plotly.newPlot(chart, figure.data, figure.layout, CONFIG);
  await Plotly.relayout(chart, makeColors(chart.layout));
  addMark(chart, isOverTime(chart) ? "cursor" : "spot");
  if (isOverTime(chart)) {
    followPointer(chart);
    chart.on("plotly_relayout", (change) => linkZoom(chart, change));
  } else followPoints(chart);
}

async function drawAll() {
  if (!("DecompressionStream" in window)) {
    for (const chart of charts) chart.innerHTML = "<p class=unsupported>This chart needs a browser of 2023 or later.</p>";
    return;
  }
  await loadLibrary();
  for (const chart of charts) await draw(chart);
  root.dataset.drawn = charts.length;
}

setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
document.getElementById("theme").addEventListener("click", () => setTheme(root.dataset.theme === "dark" ? "light" : "dark"));
drawAll();
