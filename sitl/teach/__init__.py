"""A page to teach with: what a delay does to the loop, beside what can be proved about it.

``recursion.py`` is Eqs. (4), (8) and (9) for many delay sequences at once, ``facts.py`` what is proved or refuted about
a window of delays, ``lesson.py`` puts curves and facts together for every delay that the page offers, and ``page.py``
writes them as one HTML file.
"""
