// The line to the server: questions in JSON, answers as a header and numbers.

/** Take a binary answer apart. */
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const values = header.shape ? new Float32Array(buffer, 4 + length) : null;
  return { header, values };
}

export class Connection {
  /**
   * @param {object} heard - called with what comes unasked: `hello(header)`, `frame(header, values)`,
   *   `refused(sentence)`, `lost()`.
   */
  constructor(heard) {
    this.heard = heard;
    this.waiting = new Map();
    this.last = 0;
    this.queue = [];
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/socket`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.receive(event.data);
    this.socket.onclose = () => this.closed();
  }

  receive(buffer) {
    const { header, values } = unpack(buffer);
    if (header.hello) {
      this.heard.hello(header);
      return;
    }
    if ("frame" in header) {
      this.heard.frame(header, values);
      return;
    }
    const asked = this.waiting.get(header.id);
    if (!asked) {
      if (header.error) this.heard.refused(header.error);
      return;
    }
    this.waiting.delete(header.id);
    this.next();
    if (header.error) asked.reject(new Error(header.error));
    else asked.resolve({ header, values });
  }

  closed() {
    for (const { reject } of this.waiting.values()) reject(new Error("The viewer has ended."));
    this.waiting.clear();
    this.queue = [];
    this.heard.lost();
    setTimeout(() => this.open(), 1000);
  }

  /** Send a message that is not answered. */
  tell(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  /** Ask, and get a promise of `{header, values}`; the server takes only a few at a time. */
  ask(message) {
    return new Promise((resolve, reject) => {
      this.queue.push({ message: { id: ++this.last, ...message }, resolve, reject });
      this.next();
    });
  }

  next() {
    while (this.queue.length && this.waiting.size < 3) {
      const { message, resolve, reject } = this.queue.shift();
      if (this.socket.readyState !== WebSocket.OPEN) {
        reject(new Error("The viewer has ended."));
        continue;
      }
      this.waiting.set(message.id, { resolve, reject });
      this.socket.send(JSON.stringify(message));
    }
  }
}

/** Pictures that were fetched before, the oldest leave first. */
export class Store {
  constructor(most = 160e6) {
    this.most = most;
    this.held = new Map();
    this.size = 0;
  }

  get(key) {
    const found = this.held.get(key);
    if (found) {
      this.held.delete(key);
      this.held.set(key, found);
    }
    return found;
  }

  set(key, picture) {
    if (this.held.has(key)) return;
    this.held.set(key, picture);
    this.size += picture.bytes;
    for (const [oldest, { bytes }] of this.held) {
      if (this.size <= this.most || oldest === key) break;
      this.held.delete(oldest);
      this.size -= bytes;
    }
  }

  clear() {
    this.held.clear();
    this.size = 0;
  }
}
