"""The catching task as pure functions of snapshots: throws, sensing, observations, actions, rewards, endings."""
