"""Turn on the field checks of messages, which are read once, when the messages are imported."""

import os

os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
