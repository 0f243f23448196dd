"""Small MCAP files for tests, as other recorders than ROS write them."""

import json

from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore


def write_json(path, messages, encoding="json"):
    """Writes (topic, time [s], message) in JSON."""
    channels = {}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, time, message in messages:
            if topic not in channels:
                schema = writer.register_schema(f"test.{topic[1:]}", "jsonschema", b'{"type": "object"}')
                channels[topic] = writer.register_channel(topic, encoding, schema)
            stamp = round(1e9 * time)
            writer.add_message(channels[topic], stamp, json.dumps(message).encode(), stamp)
        writer.finish()
    return path


def write_ros(path, topic, times, places, profile):
    """Writes geometry_msgs/PointStamped of ROS 2 with the profile of a recorder, without metadata beside the file."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    of, name = store.types.__getitem__, "geometry_msgs/msg/PointStamped"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=profile)
        schema = writer.register_schema(name, "ros2msg", store.generate_msgdef(name)[0].encode())
        channel = writer.register_channel(topic, "cdr", schema)
        for time, place in zip(times, places, strict=True):
            stamp = round(1e9 * time)
            header = of("std_msgs/msg/Header")(of("builtin_interfaces/msg/Time")(*divmod(stamp, 10**9)), "world")
            point = of(name)(header, of("geometry_msgs/msg/Point")(*map(float, place)))
            writer.add_message(channel, stamp, bytes(store.serialize_cdr(point, name)), stamp)
        writer.finish()
    return path
