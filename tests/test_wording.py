from lerobot_vtrefine.wording import plural


def test_counts_agree_with_their_nouns() -> None:
    counted = [plural(count, noun) for count in (0, 1, 2) for noun in ("frame", "process")]
    assert counted == ["0 frames", "0 processes", "1 frame", "1 process", "2 frames", "2 processes"]
