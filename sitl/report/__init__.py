"""The report of one flight, or of several side by side: one HTML page that needs no network.

    flight = load_flight("flight.mcap")          # sitl.flightfile: the recording holds model, gains and certificate
    html = report([flight])                      # sitl.report.page

``numbers`` measures, ``words`` says it in sentences and tables, ``panels`` draws with Bokeh what ``drawn`` has picked
of the samples and packets, and ``page`` puts them in the frame: ``page.Section`` and ``page.render`` know nothing of
flights, and make any page of this look. ``report.html``, ``report.css`` and ``report.js`` are its template, its two
themes with their switch, and what paints the figures in them.
"""
