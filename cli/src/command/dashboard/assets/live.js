// The state of a view, as the gateway sends it: a snapshot first, then changes. Orders to the gateway.

/** Sends an order. Returns the answer, which is not `ok` if the gateway is not reached. */
export async function post(path, order) {
  return fetch(path, {
    method: 'POST', headers: { 'X-Fipa': '1', 'Content-Type': 'application/json' }, body: JSON.stringify(order),
  }).catch((error) => ({ ok: false, text: () => error.message }));
}

export class Live {
  /** Follows a view; `changed` is called with its sections at most once per frame, `connected` with true or false. */
  constructor(path, changed, connected) {
    this.sections = {};
    this.changed = changed;
    this.due = 0;
    this.source = new EventSource(`api/live/${path}`);
    this.source.addEventListener('snapshot', (event) => {
      this.sections = JSON.parse(event.data);
      // An agent may have the name of a property that all objects inherit.
      for (const rows of Object.values(this.sections)) Object.setPrototypeOf(rows, null);
      connected(true);
      this.draw();
    });
    this.source.addEventListener('changes', (event) => {
      this.apply(JSON.parse(event.data));
      this.draw();
    });
    this.source.addEventListener('error', () => connected(false, this.source.readyState === EventSource.CLOSED));
  }

  apply({ set, gone }) {
    for (const [section, rows] of Object.entries(set)) {
      this.sections[section] = Object.assign(this.sections[section] ?? Object.create(null), rows);
    }
    for (const [section, keys] of Object.entries(gone)) {
      for (const key of keys) delete this.sections[section]?.[key];
    }
  }

  draw() {
    this.due ||= requestAnimationFrame(() => {
      this.due = 0;
      this.changed(this.sections);
    });
  }

  close() {
    cancelAnimationFrame(this.due);
    this.source.close();
  }
}
