//! The file format (https://mcap.dev/spec): records of an opcode, a length and a content, messages in chunks that are packed one by
//! one, and behind them all a summary with the places of the chunks. Nothing is gone back to: it may be written to a pipe.

use std::collections::BTreeMap;
use std::io::{self, Write};

use super::Compression;

const MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// Uncompressed bytes of a chunk, but for the message that fills it.
const CHUNK_BYTES: usize = 1 << 20;

/// What a record is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum Op {
    Header = 1,
    Footer = 2,
    Schema = 3,
    Channel = 4,
    Message = 5,
    Chunk = 6,
    MessageIndex = 7,
    ChunkIndex = 8,
    Statistics = 11,
    Metadata = 12,
    MetadataIndex = 13,
    SummaryOffset = 14,
    DataEnd = 15,
}

/// Properties by name.
pub(super) type Properties = BTreeMap<String, String>;

/// When a message was recorded and published, in ns since 1970, and the number of its observation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Times {
    pub(super) log_ns: u64,
    pub(super) publish_ns: u64,
    pub(super) sequence: u32,
}

/// The contents of a record.
#[derive(Default)]
struct Content(Vec<u8>);

impl Content {
    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    /// With its length in front.
    fn bytes(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn string(self, text: &str) -> Self {
        self.bytes(text.as_bytes())
    }

    fn properties(self, properties: &Properties) -> Self {
        let all = Self::default();
        let all = properties.iter().fold(all, |all, (key, value)| all.string(key).string(value));
        self.bytes(&all.0)
    }

    /// Numbers by channel.
    fn by_channel(self, numbers: impl Iterator<Item = (u16, u64)>) -> Self {
        let all = numbers.fold(Self::default(), |all, (channel, number)| all.u16(channel).u64(number));
        self.bytes(&all.0)
    }
}

fn put(to: &mut Vec<u8>, op: Op, Content(content): Content) {
    to.push(op as u8);
    to.extend((content.len() as u64).to_le_bytes());
    to.extend(content);
}

/// The chunk that is being filled.
#[derive(Default)]
struct Chunk {
    records: Vec<u8>,
    /// Times of the first and the last message by time; none without messages.
    span_ns: Option<(u64, u64)>,
    /// When each message was recorded and where it begins, by channel.
    messages: BTreeMap<u16, Vec<(u64, u64)>>,
}

/// A file that is being written.
pub(super) struct McapWriter<W: Write> {
    to: W,
    compression: Compression,
    /// Bytes written.
    offset: u64,
    chunk: Chunk,
    /// Records of the summary, by group.
    schemas: Vec<u8>,
    channels: Vec<u8>,
    chunk_indexes: Vec<u8>,
    metadata_indexes: Vec<u8>,
    counts: Counts,
}

#[derive(Default)]
struct Counts {
    schemas: u16,
    metadata: u32,
    chunks: u32,
    span_ns: Option<(u64, u64)>,
    /// Messages by channel; every channel is there.
    messages: BTreeMap<u16, u64>,
}

impl<W: Write> McapWriter<W> {
    pub(super) fn start(to: W, profile: &str, compression: Compression) -> io::Result<Self> {
        let mut this = Self {
            to,
            compression,
            offset: 0,
            chunk: Chunk::default(),
            schemas: Vec::new(),
            channels: Vec::new(),
            chunk_indexes: Vec::new(),
            metadata_indexes: Vec::new(),
            counts: Counts::default(),
        };
        let mut start = MAGIC.to_vec();
        let library = concat!("rcwm-lab ", env!("CARGO_PKG_VERSION"));
        put(&mut start, Op::Header, Content::default().string(profile).string(library));
        this.write(&start)?;
        Ok(this)
    }

    /// Writes properties of the whole file.
    pub(super) fn metadata(&mut self, name: &str, properties: &Properties) -> io::Result<()> {
        self.finish_chunk()?;
        let mut record = Vec::new();
        put(&mut record, Op::Metadata, Content::default().string(name).properties(properties));
        let index = Content::default().u64(self.offset).u64(record.len() as u64).string(name);
        put(&mut self.metadata_indexes, Op::MetadataIndex, index);
        self.counts.metadata += 1;
        self.write(&record)
    }

    /// Adds a schema; gives its number.
    pub(super) fn schema(&mut self, name: &str, encoding: &str, definition: &str) -> u16 {
        self.counts.schemas += 1;
        let id = self.counts.schemas;
        let content = Content::default().u16(id).string(name).string(encoding).string(definition);
        self.repeat(Op::Schema, content);
        id
    }

    /// Adds a channel of messages of a schema; gives its number.
    pub(super) fn channel(
        &mut self,
        schema: u16,
        topic: &str,
        encoding: &str,
        properties: &Properties,
    ) -> u16 {
        let id = self.counts.messages.len() as u16 + 1;
        self.counts.messages.insert(id, 0);
        let content = Content::default().u16(id).u16(schema).string(topic).string(encoding);
        self.repeat(Op::Channel, content.properties(properties));
        id
    }

    /// Writes a record here and into the summary.
    fn repeat(&mut self, op: Op, content: Content) {
        let mut record = Vec::new();
        put(&mut record, op, content);
        self.chunk.records.extend_from_slice(&record);
        let summary = if op == Op::Schema { &mut self.schemas } else { &mut self.channels };
        summary.extend(record);
    }

    pub(super) fn message(&mut self, channel: u16, times: Times, data: &[u8]) -> io::Result<()> {
        let Times { log_ns, publish_ns, sequence } = times;
        let at = self.chunk.records.len() as u64;
        self.chunk.messages.entry(channel).or_default().push((log_ns, at));
        self.chunk.span_ns = Some(span(self.chunk.span_ns, (log_ns, log_ns)));
        *self.counts.messages.entry(channel).or_default() += 1;
        let content = Content::default().u16(channel).u32(sequence).u64(log_ns).u64(publish_ns).raw(data);
        put(&mut self.chunk.records, Op::Message, content);
        if self.chunk.records.len() >= CHUNK_BYTES { self.finish_chunk() } else { Ok(()) }
    }

    /// Messages of a channel so far.
    pub(super) fn count(&self, channel: u16) -> u64 {
        self.counts.messages.get(&channel).copied().unwrap_or(0)
    }

    fn finish_chunk(&mut self) -> io::Result<()> {
        let Chunk { records, span_ns, messages } = std::mem::take(&mut self.chunk);
        if records.is_empty() {
            return Ok(());
        }
        let packed = match self.compression {
            Compression::Lz4 => lz4_frame(&records),
            Compression::None => records.clone(),
        };
        let (start_ns, end_ns) = span_ns.unwrap_or((0, 0));
        let (size, packed_size) = (records.len() as u64, packed.len() as u64);
        let content = Content::default().u64(start_ns).u64(end_ns).u64(size).u32(crc32fast::hash(&records));
        let content = content.string(self.compression.name()).u64(packed_size).raw(&packed);
        let (mut written, chunk_offset) = (Vec::new(), self.offset);
        put(&mut written, Op::Chunk, content);
        let chunk_bytes = written.len() as u64;
        let mut index_offsets = Vec::new();
        for (channel, places) in &messages {
            index_offsets.push((*channel, chunk_offset + written.len() as u64));
            let entries = places.iter().fold(Content::default(), |all, (ns, at)| all.u64(*ns).u64(*at));
            put(&mut written, Op::MessageIndex, Content::default().u16(*channel).bytes(&entries.0));
        }
        let index_bytes = written.len() as u64 - chunk_bytes;
        let index = Content::default().u64(start_ns).u64(end_ns).u64(chunk_offset).u64(chunk_bytes);
        let index = index.by_channel(index_offsets.into_iter()).u64(index_bytes);
        let index = index.string(self.compression.name()).u64(packed_size).u64(size);
        put(&mut self.chunk_indexes, Op::ChunkIndex, index);
        self.counts.chunks += 1;
        if let Some(of_chunk) = span_ns {
            self.counts.span_ns = Some(span(self.counts.span_ns, of_chunk));
        }
        self.write(&written)
    }

    /// Writes what is left, and the summary.
    pub(super) fn finish(mut self) -> io::Result<W> {
        self.finish_chunk()?;
        let mut end = Vec::new();
        // Zero: the checksum is not known. Every chunk has its own.
        put(&mut end, Op::DataEnd, Content::default().u32(0));
        self.write(&end)?;
        let summary_offset = self.offset;
        let groups = [
            (Op::Schema, std::mem::take(&mut self.schemas)),
            (Op::Channel, std::mem::take(&mut self.channels)),
            (Op::Statistics, self.statistics()),
            (Op::ChunkIndex, std::mem::take(&mut self.chunk_indexes)),
            (Op::MetadataIndex, std::mem::take(&mut self.metadata_indexes)),
        ];
        let (mut summary, mut offsets) = (Vec::new(), Vec::new());
        for (op, records) in groups.into_iter().filter(|(_, records)| !records.is_empty()) {
            let begin = summary_offset + summary.len() as u64;
            let content = Content(vec![op as u8]).u64(begin).u64(records.len() as u64);
            put(&mut offsets, Op::SummaryOffset, content);
            summary.extend(records);
        }
        let offsets_offset = summary_offset + summary.len() as u64;
        summary.extend(offsets);
        // The checksum is of all before it, its own record's beginning included.
        summary.push(Op::Footer as u8);
        let footer = Content::default().u64(summary_offset).u64(offsets_offset);
        summary.extend((footer.0.len() as u64 + 4).to_le_bytes());
        summary.extend(footer.0);
        summary.extend(crc32fast::hash(&summary).to_le_bytes());
        summary.extend_from_slice(MAGIC);
        self.write(&summary)?;
        self.to.flush()?;
        Ok(self.to)
    }

    fn statistics(&self) -> Vec<u8> {
        let Counts { schemas, metadata, chunks, span_ns, messages } = &self.counts;
        let (start_ns, end_ns) = span_ns.unwrap_or((0, 0));
        let content = Content::default().u64(messages.values().sum()).u16(*schemas);
        // Attachments there are none.
        let content = content.u32(messages.len() as u32).u32(0).u32(*metadata).u32(*chunks);
        let counts =
            messages.iter().map(|(channel, count)| (*channel, *count)).filter(|(_, count)| *count > 0);
        let mut record = Vec::new();
        put(&mut record, Op::Statistics, content.u64(start_ns).u64(end_ns).by_channel(counts));
        record
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.offset += bytes.len() as u64;
        self.to.write_all(bytes)
    }
}

/// What reaches over both.
fn span(of: Option<(u64, u64)>, other: (u64, u64)) -> (u64, u64) {
    of.map_or(other, |(start, end)| (start.min(other.0), end.max(other.1)))
}

/// Bytes as an LZ4 frame of independent blocks without checksums: a chunk has one of its own.
fn lz4_frame(bytes: &[u8]) -> Vec<u8> {
    /// Magic number, version 1 with independent blocks, blocks of at most 4 MiB, and the checksum of these two bytes.
    const START: [u8; 7] = [0x04, 0x22, 0x4d, 0x18, 0x60, 0x70, 0x73];
    const BLOCK_BYTES_MAX: usize = 4 << 20;
    /// The block is not packed.
    const RAW: u32 = 1 << 31;
    let mut frame = START.to_vec();
    for block in bytes.chunks(BLOCK_BYTES_MAX) {
        let packed = lz4_flex::block::compress(block);
        let (len, content) = match packed.len() < block.len() {
            true => (packed.len() as u32, &packed[..]),
            false => (block.len() as u32 | RAW, block),
        };
        frame.extend(len.to_le_bytes());
        frame.extend_from_slice(content);
    }
    frame.extend([0; 4]);
    frame
}
