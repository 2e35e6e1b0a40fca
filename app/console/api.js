/** Requests to the service, with the token of who is at the console. The only place that calls fetch. */

import { askForToken, token } from "/console/session.js";

/** What went wrong: `problem` is the answer's problem document (RFC 9457), null where there was no answer. */
class RequestFailed extends Error {
  constructor(message, problem = null) {
    super(message);
    this.problem = problem;
  }
}

/** Return the JSON of a GET; parameters that are null are left out. Throws `RequestFailed`. */
export function get(path, parameters = {}, signal = undefined) {
  const given = Object.entries(parameters).filter(([, value]) => value !== null);
  return request(given.length ? `${path}?${new URLSearchParams(given)}` : path, { signal });
}

/** Return the JSON of the answer to a POST. Throws `RequestFailed`. */
export function post(path, body) {
  return request(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
}

/** Return the JSON of the answer to a DELETE. Throws `RequestFailed`. */
export function remove(path) {
  return request(path, { method: "DELETE" });
}

/** Return the open response of the event stream, resumed after an id. Throws `RequestFailed`. */
export function openStream(lastId, signal) {
  return answer("/v1/airspace/stream", {
    headers: { Accept: "text/event-stream", ...(lastId === null ? {} : { "Last-Event-ID": lastId }) },
    cache: "no-store",
    signal,
  });
}

async function request(path, options) {
  const response = await answer(path, options);
  try {
    return await response.json();
  } catch (error) {
    throw aborted(error) ? error : new RequestFailed("the answer was cut off");
  }
}

async function answer(path, options) {
  const sent = token();
  const headers = { ...options.headers, ...(sent === null ? {} : { Authorization: `Bearer ${sent}` }) };
  let response;
  try {
    response = await fetch(path, { ...options, headers });
  } catch (error) {
    throw aborted(error) ? error : new RequestFailed("the service cannot be reached");
  }
  if (response.ok) return response;
  const problem = await response.json().catch(() => null);
  if (response.status === 401) {
    // Meanwhile another request may have got a token.
    if (token() === sent) await askForToken(refusal(problem, sent));
    return answer(path, options);
  }
  throw new RequestFailed(problem?.detail ?? `the service answered ${response.status}`, problem);
}

function refusal(problem, sent) {
  if (sent === null) return "This service wants to know who you are.";
  return `The token was not accepted${problem?.detail ? `: ${problem.detail}` : ""}.`;
}

/** Tell whether a request ended because nobody wants its answer any more. */
export const aborted = (error) => error.name === "AbortError";
