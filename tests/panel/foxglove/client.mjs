// The client and the decoders that Foxglove itself uses: prints the channels and the messages of the first seconds.
import { createRequire } from "node:module";

const [packages, address, wanted] = process.argv.slice(2);
const require = createRequire(`${packages}/`);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const WebSocket = require("ws");

const client = new FoxgloveClient({ ws: new WebSocket(address, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
const readers = new Map();
const said = { channels: [], messages: [], status: [] };
const plain = (_, value) => (typeof value === "bigint" ? Number(value) : value);

client.on("serverInfo", (info) => { said.info = info; });
client.on("status", (status) => said.status.push(status));
client.on("error", (error) => { console.error(error); process.exit(1); });
client.on("advertise", (channels) => {
  for (const channel of channels) {
    said.channels.push(channel);
    const reader = new MessageReader(parse(channel.schema, { ros2: true }));
    readers.set(client.subscribe(channel.id), { topic: channel.topic, reader });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = readers.get(subscriptionId);
  said.messages.push({ topic, timestamp, message: reader.readMessage(data) });
  if (said.messages.length >= Number(wanted)) {
    console.log(JSON.stringify(said, plain));
    client.close();
    process.exit(0);
  }
});
