"""The catching environment: it puts scene, simulation, camera and task in order, and nothing else."""
