//! The topics of a file: their channels, and what was written to each.

use std::collections::BTreeMap;
use std::io::{self, Write};

use serde::Serialize;

use super::Compression;
use super::file::{McapWriter, Properties, Times};
use super::messages::Schema;

/// What ROS 2's tools look for.
const PROFILE: &str = "ros2";
const SCHEMA_ENCODING: &str = "ros2msg";
const MESSAGE_ENCODING: &str = "cdr";

/// A topic, and what was written to it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct WrittenTopic {
    pub topic: String,
    #[serde(rename = "type")]
    pub type_name: String,
    pub messages: u64,
}

/// A file of ROS 2's messages that is being written.
pub(super) struct Bag<W: Write> {
    writer: McapWriter<W>,
    schemas: BTreeMap<Schema, u16>,
    /// By topic and properties: another robot's may have the same name.
    channels: BTreeMap<(String, Properties), (Schema, u16)>,
    /// Those without properties, by topic.
    plain: BTreeMap<String, u16>,
}

impl<W: Write> Bag<W> {
    pub(super) fn start(to: W, compression: Compression) -> io::Result<Self> {
        let writer = McapWriter::start(to, PROFILE, compression)?;
        let (schemas, channels, plain) = Default::default();
        Ok(Self { writer, schemas, channels, plain })
    }

    /// Properties of the whole file.
    pub(super) fn properties(&mut self, name: &str, properties: &Properties) -> io::Result<()> {
        self.writer.metadata(name, properties)
    }

    /// The channel of a topic.
    pub(super) fn channel(&mut self, topic: &str, schema: Schema, properties: &Properties) -> u16 {
        let key = (topic.to_owned(), properties.clone());
        if let Some((_, channel)) = self.channels.get(&key).filter(|(of, _)| *of == schema) {
            return *channel;
        }
        let writer = &mut self.writer;
        let add = || writer.schema(schema.name(), SCHEMA_ENCODING, &schema.definition());
        let id = *self.schemas.entry(schema).or_insert_with(add);
        let channel = self.writer.channel(id, topic, MESSAGE_ENCODING, properties);
        self.channels.insert(key, (schema, channel));
        channel
    }

    pub(super) fn write(&mut self, channel: u16, times: Times, data: &[u8]) -> io::Result<()> {
        self.writer.message(channel, times, data)
    }

    /// The same to a topic that is about no part of the robot.
    pub(super) fn write_to(
        &mut self,
        topic: &str,
        schema: Schema,
        times: Times,
        data: &[u8],
    ) -> io::Result<()> {
        let channel = match self.plain.get(topic) {
            Some(channel) => *channel,
            None => {
                let channel = self.channel(topic, schema, &Properties::new());
                self.plain.insert(topic.to_owned(), channel);
                channel
            }
        };
        self.write(channel, times, data)
    }

    /// Writes the summary; gives the topics, and what was written to.
    pub(super) fn finish(self) -> io::Result<(Vec<WrittenTopic>, W)> {
        let written =
            |((topic, _), (schema, channel)): (&(String, Properties), &(Schema, u16))| WrittenTopic {
                topic: topic.clone(),
                type_name: schema.name().to_owned(),
                messages: self.writer.count(*channel),
            };
        let topics = self.channels.iter().map(written).collect();
        Ok((topics, self.writer.finish()?))
    }
}
