// Rates of the last minutes. The library uPlot draws them (uplot.js).

import { clock, element } from './elements.js';

const HEIGHT = 150;

/** A chart of the letters per second and of those that were not delivered, with its newest values as text. */
export function chart() {
  const box = element('div', { 'aria-hidden': 'true' });
  const words = element('figcaption', {});
  const node = element('figure', { class: 'card chart' }, words, box);
  let plot = null;
  let marked = null;
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  /** Draws a line at the marked time. */
  const drawMark = ({ ctx, bbox, valToPos }) => {
    if (marked === null) return;
    const place = Math.round(valToPos(marked, 'x', true));
    ctx.fillStyle = color('--ink');
    ctx.fillRect(place - 1, bbox.top, 2, bbox.height);
  };
  const begin = (data) => {
    const axis = { stroke: color('--faint'), grid: { stroke: color('--line') }, ticks: { stroke: color('--line') } };
    plot = new globalThis.uPlot({
      width: Math.max(200, box.clientWidth), height: HEIGHT, legend: { show: false }, cursor: { show: false },
      scales: { y: { range: (_, low, high) => [0, Math.max(1, high * 1.1)] } },
      axes: [{ ...axis, space: 90, values: (_, times) => times.map((time) => clock(time * 1000)) }, { ...axis, size: 60 }],
      hooks: { draw: [drawMark] },
      series: [{}, { stroke: color('--accent'), width: 2, fill: `${color('--accent')}22` },
        { stroke: color('--bad'), width: 2 }],
    }, data, box);
  };
  const resized = new ResizeObserver(() => plot?.setSize({ width: Math.max(200, box.clientWidth), height: HEIGHT }));
  resized.observe(box);
  return {
    node,
    /** Marks this time, in seconds since 1970, when the points are shown the next time. */
    mark(time) {
      marked = time;
    },
    show(points) {
      const times = Object.keys(points).map(Number).sort((a, b) => a - b);
      if (times.length === 0) return;
      const values = (key) => times.map((time) => points[time][key]);
      const data = [times, values('letters_per_second'), values('failures_per_second')];
      if (plot) plot.setData(data);
      else begin(data);
      const minutes = Math.max(1, Math.round((times.at(-1) - times[0]) / 60));
      const text = `Letters per second, the last ${minutes === 1 ? 'minute' : `${minutes} minutes`}: `
        + `at most ${Math.max(...data[1]).toFixed(1)}; not delivered: at most ${Math.max(...data[2]).toFixed(1)}`;
      if (words.textContent !== text) words.textContent = text;
    },
    /** Frees what the chart holds beside its nodes. */
    close() {
      resized.disconnect();
      plot?.destroy();
      plot = null;
    },
  };
}
