// Elements are made with text nodes only: no name of an agent becomes markup.

const SVG = 'http://www.w3.org/2000/svg';

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === 'on') for (const [event, handler] of Object.entries(value)) node.addEventListener(event, handler);
    else node.setAttribute(name, value === true ? '' : String(value));
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

export function element(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

export function drawing(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

/** A link to a view. */
export function link(view, name, text = name) {
  return element('a', { href: `#/${view}/${encodeURIComponent(name)}` }, text);
}

/**
 * The body of a table whose rows have keys. A row that did not change keeps its nodes, so that focus, selection and
 * the place of scrolling stay.
 */
export class Rows {
  constructor(body, draw) {
    this.body = body;
    this.draw = draw;
    this.shown = new Map();
  }

  /** Shows these rows, pairs of key and value, in this order. */
  show(rows) {
    const kept = new Map();
    let place = this.body.firstChild;
    for (const [key, value] of rows) {
      const text = JSON.stringify(value);
      const before = this.shown.get(key);
      let node = before?.node;
      if (before?.text !== text) {
        node = this.draw(value, key);
        before?.node.replaceWith(node);
        if (before && place === before.node) place = node;
      }
      if (node === place) place = place.nextSibling;
      else this.body.insertBefore(node, place);
      kept.set(key, { node, text });
      this.shown.delete(key);
    }
    for (const { node } of this.shown.values()) node.remove();
    this.shown = kept;
  }
}

/** A table with a caption for readers of the screen, in a box that scrolls sideways. */
export function table(caption, columns, draw) {
  const heads = columns.map((column) => element('th', { scope: 'col', class: column.class }, column.title));
  const body = element('tbody');
  const node = element('div', { class: 'wide' },
    element('table', {}, element('caption', {}, caption), element('thead', {}, element('tr', {}, heads)), body));
  return { node, rows: new Rows(body, draw) };
}

/** The violations and failures of an agent or a conversation. */
export function problems({ violations, failures }) {
  const found = [];
  if (violations) found.push(`${violations} ${violations === 1 ? 'violation' : 'violations'}`);
  if (failures) found.push(`${failures} not delivered`);
  return found.join(', ');
}

export function rate(value) {
  return value === undefined || value === null ? '' : value >= 100 ? value.toFixed(0) : value.toFixed(1);
}

export function span(micros) {
  if (micros === undefined || micros === null) return '';
  if (micros < 1000) return `${micros} µs`;
  if (micros < 1_000_000) return `${(micros / 1000).toPrecision(3)} ms`;
  return `${(micros / 1_000_000).toPrecision(3)} s`;
}

export function seconds(value) {
  if (value === undefined || value === null) return '';
  if (value < 120) return `${value} s`;
  if (value < 7200) return `${Math.round(value / 60)} min`;
  return `${Math.round(value / 3600)} h`;
}

/** The time of day of a time in RFC 3339. */
export function clock(time) {
  if (!time) return '';
  const date = new Date(time);
  return Number.isNaN(date.getTime()) ? time : date.toLocaleTimeString([], { hour12: false });
}
