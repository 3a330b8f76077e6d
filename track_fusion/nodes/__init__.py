"""ROS 2 nodes: thin carriers between messages and the library."""
