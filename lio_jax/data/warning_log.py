"""What a reader has to say about the problems it met, each once however often the recording is replayed."""


class WarningLog:
    """Collect sentences in the order they first came up."""

    def __init__(self) -> None:
        self._sentences: dict[str, None] = {}

    def add(self, sentence: str) -> None:
        """Remember ``sentence`` unless it was said before."""
        self._sentences[sentence] = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """All sentences so far; safe to ask while another thread decodes."""
        return tuple(self._sentences.copy())
