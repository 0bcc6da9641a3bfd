"""Launch files of pixel2catch for ROS 2; the Python code is in the package `pixel2catch`."""
