// The state of a view, as the gateway sends it: a snapshot first, then changes.

export class Live {
  /** Follows a view; `changed` is called with its sections at most once per frame, `connected` with true or false. */
  constructor(path, changed, connected) {
    this.sections = {};
    this.changed = changed;
    this.due = 0;
    this.source = new EventSource(`api/live/${path}`);
    this.source.addEventListener('snapshot', (event) => {
      this.sections = JSON.parse(event.data);
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
      this.sections[section] = Object.assign(this.sections[section] ?? {}, rows);
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
