// Foxglove's own client and decoders: subscribe to all channels of ADDRESS and print the first COUNT messages as JSON.
import { createRequire } from "node:module";

const [packages, address, count] = process.argv.slice(2);
const require = createRequire(`${packages}/`);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const WebSocket = require("ws");

const client = new FoxgloveClient({ ws: new WebSocket(address, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
const readers = new Map();
const received = { channels: [], messages: [], status: [] };
const replaceBigint = (_, value) => (typeof value === "bigint" ? Number(value) : value);

client.on("serverInfo", (info) => { received.info = info; });
client.on("status", (status) => received.status.push(status));
client.on("error", (error) => { console.error(error); process.exit(1); });
client.on("advertise", (channels) => {
  for (const channel of channels) {
    received.channels.push(channel);
    const reader = new MessageReader(parse(channel.schema, { ros2: true }));
    readers.set(client.subscribe(channel.id), { topic: channel.topic, reader });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = readers.get(subscriptionId);
  received.messages.push({ topic, timestamp, message: reader.readMessage(data) });
  if (received.messages.length >= Number(count)) {
    console.log(JSON.stringify(received, replaceBigint));
    client.close();
    process.exit(0);
  }
});
