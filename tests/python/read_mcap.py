"""Reads an MCAP file of ROS 2's messages with the readers of others, and says as JSON what is in it.

    read_mcap.py FILE IMAGE_TOPIC JOINT_TOPIC NUMBERS_TOPIC
"""

import json
import sys
from collections import Counter

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def time_ns(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def main():
    path, image_topic, joint_topic, numbers_topic = sys.argv[1:]
    counts, types, messages = Counter(), {}, {image_topic: [], joint_topic: [], numbers_topic: []}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header, summary = reader.get_header(), reader.get_summary()
        # Every message is decoded, not only those that are told.
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            types[channel.topic] = schema.name
            if channel.topic in messages:
                messages[channel.topic].append((message, decoded))
    _, image = messages[image_topic][-1]
    _, joints = messages[joint_topic][-1]
    last, numbers = messages[numbers_topic][-1]
    told = {
        "profile": header.profile,
        "indexed": summary.statistics.message_count,
        "chunks": len(summary.chunk_indexes),
        "counts": counts,
        "types": types,
        "image": {
            "stamp_ns": time_ns(image.header.stamp),
            "frame": image.header.frame_id,
            "size": [image.height, image.width, image.step],
            "encoding": image.encoding,
            "data": list(image.data),
        },
        "joints": {
            "stamp_ns": time_ns(joints.header.stamp),
            "name": list(joints.name),
            "position": list(joints.position),
            "velocity": list(joints.velocity),
            "effort": list(joints.effort),
        },
        "numbers": {
            "publish_ns": last.publish_time,
            "label": numbers.layout.dim[0].label,
            "data": list(numbers.data),
        },
    }
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main()
