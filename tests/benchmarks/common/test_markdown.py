from benchmarks.common.markdown import estimate, markdown, number


def test_tables():
    assert markdown(["a", "b"], [[1, "x"], [2.0, ""]]) == (
        "| a | b |\n| --- | --- |\n| 1 | x |\n| 2.00 |  |"
    )


def test_numbers_have_three_digits():
    assert number(1234.5) == "1234"
    assert number(0.012345) == "0.0123"


def test_estimates():
    assert estimate([1.0, 0.5, 2.0]) == "1.00 [0.50, 2.00]"
    assert estimate([1234.5, -2.0, 5000.0], None) == "1,234 [-2, 5,000]"
    assert estimate([0.12345, 0.1, 0.2], None) == "0.123 [0.100, 0.200]"
    assert estimate([12345.6, 1.0, 2.0], ".0f") == "12346 [1, 2]"
    assert estimate([7.0, float("nan"), float("nan")]) == "7.00"
