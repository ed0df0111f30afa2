from cosim.recording.glyphs import drawable


def test_letters_that_the_viewer_has_stay():
    text = "X2 [kg/min] θ λ µ °C – “naïve”\nЖ"
    assert drawable(text) == text


def test_others_become_question_marks():
    assert drawable("∇L 水 🙂") == "?L ? ?"
    assert drawable("a\x00b\tc") == "a?b?c"
