// Draw the charts of a report.
"use strict";

const places = [...document.querySelectorAll(".chart")];

async function loadLibrary() {
  const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

// on a telephone a title has no room for a legend beside it: the legend is within the panel, and small
function fitLegends(layout) {
  const isNarrow = matchMedia("(max-width: 600px)").matches;
  if (!isNarrow || !layout.annotations?.some((each) => each.text !== "<b></b>")) return layout;
  for (const key of Object.keys(layout).filter((name) => name.startsWith("legend")))
    Object.assign(layout[key], { yanchor: "top", bgcolor: "rgba(0,0,0,0)", font: { size: 9 }, itemwidth: 30 });
  return layout;
}

async function drawAll() {
  if (!("DecompressionStream" in window)) {
    for (const chart of places) chart.innerHTML = "<p class=unsupported>This chart needs a browser of 2023 or later.</p>";
    return;
  }
  await loadLibrary();
  for (const chart of places) {
    const figure = JSON.parse(chart.firstElementChild.textContent);
    await drawChart(chart, { data: figure.data, layout: fitLegends(figure.layout) });
  }
  root.dataset.drawn = charts.length;
}

function setTheme(theme) {
  root.dataset.theme = theme;
  document.getElementById("theme").textContent = theme === "dark" ? "Light" : "Dark";
  colorCharts();
}

setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
document.getElementById("theme").addEventListener("click", () => setTheme(root.dataset.theme === "dark" ? "light" : "dark"));
drawAll();
