/**
 * Connection of this page to its session on the server.
 *
 * The connection is reopened automatically, and the last query is restored. The class dispatches `status` events with
 * `online` and `reason`, and one event for each message. The name of that event is the type of the message.
 */

/** @typedef {{type: string, seq?: number, [name: string]: any}} Message */

const DELAYS = [300, 600, 1000, 2000, 4000];

/** @param {ArrayBuffer} frame @returns {{header: Message, payload: Uint8Array}} */
export function parseFrame(frame) {
  const size = new DataView(frame).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(frame, 4, size)));
  return { header, payload: new Uint8Array(frame, 4 + size) };
}

export class Connection extends EventTarget {
  /** @param {string} run Id of the run. @param {() => object} greeting Returns the value of the first action. */
  constructor(run, greeting) {
    super();
    this.run = run;
    this.greeting = greeting;
    this.seq = 0;
    this.greeted = 0;
    this.attempts = 0;
    this.online = false;
    this.key = `normlift:${run}`;
    this.open();
  }

  /** @returns {Record<string, string>} Data about the session, which this tab stores and keeps after a reload. */
  get memory() {
    return JSON.parse(sessionStorage.getItem(this.key) ?? "{}");
  }

  /** @param {Record<string, string>} facts */
  remember(facts) {
    sessionStorage.setItem(this.key, JSON.stringify({ ...this.memory, ...facts }));
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/api/runs/${encodeURIComponent(this.run)}/session`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.attempts = 0;
      this.greeted = this.send("greet", this.greeting());
      this.report(true);
    };
    this.socket.onmessage = ({ data }) => this.receive(data);
    this.socket.onclose = ({ reason }) => {
      this.report(false, reason);
      const delay = DELAYS[Math.min(this.attempts++, DELAYS.length - 1)];
      setTimeout(() => this.open(), delay);
    };
  }

  /** @param {boolean} online @param {string} [reason] */
  report(online, reason = "") {
    this.online = online;
    this.dispatchEvent(Object.assign(new Event("status"), { online, reason }));
  }

  /** @param {string | ArrayBuffer} data */
  receive(data) {
    const { header, payload } =
      typeof data === "string" ? { header: JSON.parse(data), payload: null } : parseFrame(data);
    this.dispatchEvent(Object.assign(new Event(header.type), { message: header, payload }));
  }

  /** @param {string} action @param {any} [value] @returns {number} Number of the message, -1 if offline. */
  send(action, value = null) {
    if (this.socket?.readyState !== WebSocket.OPEN) return -1;
    this.seq++;
    this.socket.send(JSON.stringify({ action, value, seq: this.seq }));
    return this.seq;
  }
}
