"""An experiment without photographs iterates over step numbers."""

import lightning
from torch.utils.data import DataLoader

from dolens.experiments.checks import check_count


class IterationData(lightning.LightningDataModule):
    """`IterationData` yields the numbers of the iterations of an epoch; for a test, one.

    Args:
        iterations: steps in an epoch.

    Raises:
        InputError: fewer than one.
    """

    def __init__(self, iterations: int = 1) -> None:
        super().__init__()
        check_count("data.iterations", iterations)
        self.iterations = iterations

    def train_dataloader(self) -> DataLoader:
        """Return 0, 1, 2, ..."""
        return DataLoader(range(self.iterations), batch_size=1)

    def test_dataloader(self) -> DataLoader:
        """Return one step."""
        return DataLoader(range(1), batch_size=1)
