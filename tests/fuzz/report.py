"""Cases and failures of a fuzzing campaign."""

import time
from dataclasses import dataclass, field


@dataclass
class Report:
    """Cases tried and failures, by class of case. It ends a campaign when its time is over."""

    name: str
    cases: int
    seconds: float
    began: float = field(default_factory=time.monotonic)
    tried: dict[str, int] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)

    @property
    def over(self) -> bool:
        """Whether all cases are done or the time is over."""
        return self.total >= self.cases or time.monotonic() - self.began > self.seconds

    @property
    def total(self) -> int:
        """Number of cases tried so far."""
        return sum(self.tried.values())

    def add(self, kind: str, failure: str | None = None) -> None:
        """Count one case of class `kind`.

        `failure`: how to repeat the case, and what went wrong."""
        self.tried[kind] = self.tried.get(kind, 0) + 1
        if failure is not None:
            self.failures.append((kind, failure))

    def table(self) -> str:
        """Return the numbers of cases tried and failed for each class, then each failure."""
        failed = {kind: sum(k == kind for k, _ in self.failures) for kind in self.tried}
        width = max([len(kind) for kind in self.tried] + [len("all")])
        rows = [f"  {kind:<{width}} {self.tried[kind]:>8} {failed[kind]:>7}" for kind in self.tried]
        seconds = time.monotonic() - self.began
        head = f"{self.name}: {self.total} of {self.cases} cases in {seconds:.0f} s"
        titles = f"  {'class':<{width}} {'tried':>8} {'failed':>7}"
        total = f"  {'all':<{width}} {self.total:>8} {len(self.failures):>7}"
        wrong = [f"  FAILED {kind}: {text}" for kind, text in self.failures[:20]]
        return "\n".join([head, titles, *rows, total, *wrong])
