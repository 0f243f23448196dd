"""Small ROS 2 bags for tests."""

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore


def write_points(path, topics, rate):
    """Writes an MCAP bag of geometry_msgs/PointStamped, with (T, 3) places [m] by topic."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    of = lambda name: store.types[name]  # noqa: E731
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, places in topics.items():
            connection = writer.add_connection(topic, "geometry_msgs/msg/PointStamped", typestore=store)
            for frame, place in enumerate(places):
                time = round(1e9 * (10.0 + frame / rate))
                stamp = of("builtin_interfaces/msg/Time")(*divmod(time, 1_000_000_000))
                header = of("std_msgs/msg/Header")(stamp, "world")
                point = of("geometry_msgs/msg/PointStamped")(header, of("geometry_msgs/msg/Point")(*map(float, place)))
                writer.write(connection, time, store.serialize_cdr(point, point.__msgtype__))
    return path
