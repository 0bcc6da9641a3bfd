"""All methods with several seeds: training, evaluation, report."""
