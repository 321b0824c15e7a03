// Reads an MCAP file with @mcap/core, once as a stream with every checksum and once through its index, and prints what it found as JSON.
const fs = require("node:fs/promises");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const fzstd = require("fzstd");

const decompressHandlers = { zstd: (bytes, size) => fzstd.decompress(bytes, new Uint8Array(Number(size))) };

async function main(path) {
  const bytes = await fs.readFile(path);
  const schemas = new Map();
  const found = { schemas: {}, streamed: {}, indexed: {}, chunks: 0, chunksWithCrc: 0, isWhole: false };
  const topics = new Map();

  const stream = new McapStreamReader({ validateCrcs: true, includeChunks: true, decompressHandlers });
  stream.append(bytes);
  for (let record; (record = stream.nextRecord()); ) {
    if (record.type === "Chunk") {
      found.chunks += 1;
      found.chunksWithCrc += record.uncompressedCrc !== 0;
    } else if (record.type === "Schema") {
      schemas.set(record.id, record.name);
    } else if (record.type === "Channel") {
      topics.set(record.id, record.topic);
      found.schemas[record.topic] = schemas.get(record.schemaId);
    } else if (record.type === "Message") {
      const topic = topics.get(record.channelId);
      found.streamed[topic] = (found.streamed[topic] ?? 0) + 1;
    }
  }
  found.isWhole = stream.done();

  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + length))),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  let last = 0n;
  for await (const message of reader.readMessages()) {
    if (message.logTime < last) throw new Error("the index gives messages out of the order of time");
    last = message.logTime;
    const topic = reader.channelsById.get(message.channelId).topic;
    found.indexed[topic] = (found.indexed[topic] ?? 0) + 1;
  }
  process.stdout.write(JSON.stringify(found));
}

main(process.argv[2]).catch((error) => {
  process.stderr.write(`${error.message}\n`);
  process.exitCode = 1;
});
