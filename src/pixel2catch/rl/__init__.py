"""Training with MAPPO: the only folder that knows skrl."""

from pixel2catch.rl import lone_skrl as lone_skrl  # isort: split

from pixel2catch.rl.config import PRESETS as PRESETS
from pixel2catch.rl.config import TrainCfg as TrainCfg
from pixel2catch.rl.config import preset as preset
from pixel2catch.rl.train import TrainResult as TrainResult
from pixel2catch.rl.train import train as train
