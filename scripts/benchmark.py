"""Times the simulator: forward and backward milliseconds a step, the parts of a step, and the cold start.

python scripts/benchmark.py [benchmark.quick=true] [device=cuda] [mesh=NAME] [benchmark.KEY=VALUE]

Exit code: 0, or 2 for an input that cannot be used.
"""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from warp_resphys.cli import hydra_entry


@hydra_entry("benchmark")
def main(config: DictConfig) -> None:
    """Writes benchmark.json into the run folder and prints its tables."""
    from rich.console import Console

    from warp_resphys.io.files import write_json
    from warp_resphys.studies.benchmark import benchmark_tables, run_benchmark

    result = run_benchmark(cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)))
    file = Path(HydraConfig.get().runtime.output_dir) / "benchmark.json"
    write_json(file, result)
    console = Console()
    for table in benchmark_tables(result):
        console.print(table)
    console.print(f"Written: {file}")


if __name__ == "__main__":
    main()
