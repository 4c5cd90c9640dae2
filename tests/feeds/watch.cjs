// A client of the Foxglove WebSocket protocol as Lichtblick is one: Foxglove's own packages, foxglove.websocket.v1.
//
//     NODE_PATH=FOLDER/node_modules node tests/feeds/watch.cjs URL SECONDS OUT.json [STEPS]
//
// Subscribes to every channel, decodes every message by the schema that came with the channel, and writes what it saw
// as JSON: {serverInfo, channels, messages: [{topic, time, bytes, value}], times, parameters, status}. STEPS is JSON,
// [[after_s, [{"name", "value"}, ...]], ...]: parameters to set on the way.

const { writeFileSync } = require("node:fs");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");

const [url, seconds, out, steps = "[]"] = process.argv.slice(2);
const seen = { channels: [], messages: [], times: [], parameters: [], status: [], errors: [] };
const subscribed = new Map();

const plain = (_, value) => {
  if (typeof value === "bigint") return value.toString();
  return ArrayBuffer.isView(value) ? Array.from(value) : value;
};

function reader(channel) {
  if (channel.encoding === "json") {
    JSON.parse(channel.schema);
    return (bytes) => JSON.parse(new TextDecoder().decode(bytes));
  }
  if (channel.encoding !== "cdr" || channel.schemaEncoding !== "ros2msg") {
    throw new Error(`${channel.topic}: ${channel.encoding} by ${channel.schemaEncoding}`);
  }
  const messages = new MessageReader(parse(channel.schema, { ros2: true }));
  return (bytes) => messages.readMessage(bytes);
}

const client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
client.on("error", (error) => {
  console.error(error);
  process.exit(1);
});
client.on("close", () => {
  console.error("the server closed the connection");
  process.exit(1);
});
client.on("status", (status) => seen.status.push(status));
client.on("serverInfo", (info) => (seen.serverInfo = info));
client.on("time", ({ timestamp }) => seen.times.push(timestamp));
client.on("parameterValues", ({ parameters }) => seen.parameters.push(parameters));
client.on("advertise", (channels) => {
  for (const channel of channels) {
    seen.channels.push(channel);
    subscribed.set(client.subscribe(channel.id), { channel, read: reader(channel) });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { channel, read } = subscribed.get(subscriptionId);
  const bytes = Buffer.from(data.buffer, data.byteOffset, data.byteLength);
  const value = read(data);
  seen.messages.push({ topic: channel.topic, time: timestamp, bytes: bytes.toString("base64"), value });
});
client.on("open", () => {
  for (const [after, parameters] of JSON.parse(steps)) {
    setTimeout(() => client.setParameters(parameters, `at ${after}`), after * 1000);
  }
  setTimeout(() => {
    writeFileSync(out, JSON.stringify(seen, plain));
    process.exit(0);
  }, seconds * 1000);
});
