"""The one exception that reaches a user as a sentence instead of a traceback, and the form of a sentence."""


class LioJaxError(Exception):
    """A job cannot go on: the message names the file, topic or key at fault and says what to do.

    The command line prints it without a traceback and exits with status 1.
    """


class UsageError(LioJaxError):
    """The request itself is wrong (unknown key, impossible value): exit status 2."""


_LONGEST_WORD = 300
_SHOWN = 60


def one_line(sentence: str) -> str:
    """Return a sentence for a terminal: names and values in it may come from a damaged file.

    Line breaks and characters that cannot be printed become spaces, and of a word of hundreds of characters,
    unless it is a path, only the beginning is left.
    """
    if not sentence.isprintable():
        sentence = " ".join("".join(letter if letter.isprintable() else " " for letter in sentence).split())
    if len(sentence) <= _LONGEST_WORD:
        return sentence
    words = sentence.split(" ")
    long = (len(word) > _LONGEST_WORD and not word.startswith("/") for word in words)
    return " ".join(f"{word[:_SHOWN]}..." if cut else word for word, cut in zip(words, long, strict=True))
