/** The event stream, for ever: read, watched, taken up again after a loss. */

import { openStream } from "/console/api.js";
import { EventParser } from "/console/sse.js";

const SILENT_MS = 8_000;
const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8_000;

/** Return how long to wait before an attempt, given how many have failed: doubling, with some chance in it. */
export function waitMs(failures, random = Math.random()) {
  const longest = Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** (failures - 1));
  return longest * (0.5 + random / 2);
}

/**
 * Read the stream until the page closes; `onOpen` and `onLost` are told when it begins and ends. `onRefused` is told
 * why if the token is not for it, which asking again would not change.
 */
export async function follow({ onOpen, onEvent, onLost, onRefused }) {
  const memory = { lastId: null };
  let failures = 0;
  for (;;) {
    try {
      await read(memory, {
        onOpen: () => {
          failures = 0;
          onOpen();
        },
        onEvent,
      });
    } catch (error) {
      console.info(`event stream: ${error.message}`);
      if (error.problem?.status === 403) {
        onRefused(error.message);
        return;
      }
    }
    failures += 1;
    onLost();
    await wait(waitMs(failures));
  }
}

async function read(memory, { onOpen, onEvent }) {
  const controller = new AbortController();
  let watchdog;
  const alive = () => {
    clearTimeout(watchdog);
    watchdog = setTimeout(() => controller.abort(), SILENT_MS);
  };
  alive();
  try {
    const response = await openStream(memory.lastId, controller.signal);
    const parser = new EventParser();
    onOpen();
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      alive();
      for (const { event, data } of parser.feed(value)) deliver(onEvent, event, data);
      memory.lastId = parser.lastId ?? memory.lastId;
    }
  } finally {
    clearTimeout(watchdog);
  }
}

/** Hand an event on; a fault of ours in its handling is reported, and does not end the stream. */
function deliver(onEvent, event, data) {
  try {
    onEvent(event, JSON.parse(data));
  } catch (error) {
    reportError(error);
  }
}

/** Wait, but not longer than until the network is said to be back. */
function wait(ms) {
  const over = new AbortController();
  return new Promise((resolve) => {
    setTimeout(resolve, ms);
    addEventListener("online", resolve, { signal: over.signal });
  }).finally(() => over.abort());
}
