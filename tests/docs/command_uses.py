"""What a page tells its readers to run."""

import re


def uses(text: str, command: str) -> list[tuple[str, list[str]]]:
    """Commands in blocks and in code within a line, with the flags that they are given.

    Args:
        text: a page, or a command's help in a block.
        command: pattern of what is called; its group is the name.
    """
    pieces = re.findall(r"```bash\n(.*?)```|`([^`\n]+)`", text, re.DOTALL)
    lines = [line for piece in pieces for line in "".join(piece).replace("\\\n", " ").splitlines()]
    found = []
    for line in lines:
        name = re.search(rf"(?:^|\s){command}(?=\s|$)(.*)", line)
        if name is not None:
            words = re.split(r"&&| #", name[2])[0]
            found.append((name[1], re.findall(r"(?<=\s)--[\w.]+", words)))
    return found
