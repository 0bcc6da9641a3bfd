"""The catching task as pure functions of snapshots."""
