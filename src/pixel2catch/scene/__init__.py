"""The robot, the thrown objects and their scene as data and as a MuJoCo model."""
