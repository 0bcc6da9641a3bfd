"""Names of the shapes of tensors that have one row per environment."""

from jaxtyping import Bool, Float, Int
from torch import Tensor

Scalars = Float[Tensor, " num_envs"]
Counts = Int[Tensor, " num_envs"]
Flags = Bool[Tensor, " num_envs"]
Vectors = Float[Tensor, "num_envs 3"]  #: Along x, y and z.
Quaternions = Float[Tensor, "num_envs 4"]  #: (w, x, y, z), of length 1.
Boxes = Float[Tensor, "num_envs 4"]  #: xmin, ymin, xmax, ymax [px].
Joints = Float[Tensor, "num_envs num_joints"]  #: In joint order.
Features = Float[Tensor, "num_envs k"]
Points = Float[Tensor, "num_envs num_points 3"]
ImagePoints = Float[Tensor, "num_envs num_points 2"]  #: (u, v) [px].
PointScalars = Float[Tensor, "num_envs num_points"]
PointFlags = Bool[Tensor, "num_envs num_points"]
ByAgent = dict[str, Float[Tensor, "num_envs _"]]  #: Inputs or outputs of each agent's network, by its name.
