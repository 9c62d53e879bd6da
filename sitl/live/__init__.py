"""A flight on a page while it is flown: ``sitl live``.

Nothing in a flight knows of this. Recordings reach the disk in small pieces, so whoever follows the file sees the
flight half a second later, cannot disturb it, and may come and go.

    follower.py   bytes of a growing recording in, its records out
    tail.py       the growing file, and which of many is the newest
    feed.py       records to the rows that the page draws, and the numbers beside them
    session.py    one flight after another: file, feed, and what is told to those who look
    server.py     the page and its stream over HTTP, for this machine alone
    page.py       the page, and what it does with the stream
    foxglove.py   the same records for Foxglove
"""
