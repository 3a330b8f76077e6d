"""Messages at the door of the library: what the nodes and the readers of bags have in common, without ROS."""
