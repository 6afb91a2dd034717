// Connection state: a banner while the service doesn't answer, and reconnection.

import { say } from "../banner.js";
import { Refusal, call } from "./api.js";

const SHORTEST_WAIT = 1000;
const MAX_WAIT = 5000;
const GROWTH = 1.5;

export class Connection {
  /** `recovered` is called when the service answers again, `keyNeeded` when it needs a key. */
  constructor({ recovered, keyNeeded }) {
    this.recovered = recovered;
    this.keyNeeded = keyNeeded;
    this.isLost = false;
    this.timer = 0;
  }

  /** Show an error, and retry later if that can help. */
  failed(error) {
    if (error.retryAfter) this.#lose(error.message, error.retryAfter * 1000);
    else if (error instanceof Refusal && error.status === 401) {
      say("The service asks for a key.");
      this.keyNeeded();
    } else say(error.message);
  }

  #lose(text, wait) {
    say(text);
    if (this.isLost) return;
    this.isLost = true;
    this.#tryAfter(Math.max(wait, SHORTEST_WAIT));
  }

  #tryAfter(wait) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#try(wait), wait);
  }

  async #try(wait) {
    try {
      await call("ready");
    } catch (error) {
      say(error.message);
      this.#tryAfter(Math.min(wait * GROWTH, MAX_WAIT));
      return;
    }
    this.isLost = false;
    say("");
    this.recovered();
  }
}
