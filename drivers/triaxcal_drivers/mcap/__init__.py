"""Messages of other people's MCAP files: what ROS 2 recorded, JSON and
protobuf."""
