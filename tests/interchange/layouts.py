"""Files in the layouts of laboratories' programs, built in memory: a line each, with what the program's manual says.

`T`, `U` and `X` are the measurement that a layout holds where nothing else is said: times at 10 kHz in s, a drive in V,
a position in µm. A Layout's `columns` are the names, units and values that a reading must give; its `rate_hz` the rate.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

N, RATE = 60, 10_000.0
T = np.arange(N) / RATE
U = np.round(2.0 * np.sin(2 * np.pi * 200 * T), 4)
X = np.round(1.5 * U - 0.375, 4)
NAN = float("nan")


def rows(*columns: Any, sep: str = ",", fmt: str = "%.4f", end: str = "\n", decimal: str = ".") -> str:
    """Return the lines of columns; texts stay as they are."""
    lines = (
        sep.join(v if isinstance(v, str) else (fmt % v).replace(".", decimal) for v in row)
        for row in zip(*columns, strict=True)
    )
    return "".join(line + end for line in lines)


class Layout(NamedTuple):
    """A file of a program; `source` is where its layout is described, `columns` {name: (unit, values)}."""

    program: str
    layout: str
    source: str
    content: bytes
    columns: dict[str, tuple[str | None, Any]]
    rate_hz: float | None = RATE
    name: str = "scan.csv"


def text(
    program: str, layout: str, source: str, content: str, columns: Any = None, rate_hz: float | None = RATE,
    encoding: str = "utf-8", pack: Callable[[bytes], bytes] = bytes,
) -> Layout:  # fmt: skip
    """Return a layout of a text file; without `columns`, time, u and x under these names."""
    if columns is None:
        columns = {"u [V]": ("V", U), "x [um]": ("um", X)}
    return Layout(program, layout, source, pack(content.encode(encoding)), columns, rate_hz)


def _whole(values: Any) -> list[str]:
    return [str(int(value)) for value in values]


HEAD = "Time [s],u [V],x [um]\n"
BODY = rows(T, U, X)
COUNT = _whole(range(N))
ISO = [f"2024-03-04 12:00:00.{k:04d}" for k in range(N)]
CLOCK = [f"12:00:00.{k:04d}" for k in range(N)]
OVER = [7, 8, 40]
X_OVER = np.where(np.isin(np.arange(N), OVER), NAN, X)
T_SLOW, U_SLOW = T[:20] * 5, U[:20]


def _marked(marker: str) -> list[str]:
    return [marker if k in OVER else f"{x:.4f}" for k, x in enumerate(X)]


def _side_block() -> str:
    block = [
        "Record Length,6.000000e+01,", "Sample Interval,1.000000e-04,", "Trigger Point,3.000000000000e+01,", ",,", ",,",
        ",,", "Source,CH1,", "Vertical Units,V,", "Vertical Scale,5.000000e-01,", "Vertical Offset,0.000000e+00,",
        "Horizontal Units,s,", "Horizontal Scale,2.500000e-04,", "Pt Fmt,Y,", "Yzero,0.000000e+00,",
        "Probe Atten,1.000000e+00,", "Model Number,TDS2024B,", "Serial Number,C012345,", "Firmware Version,FV:v22.11,",
    ]  # fmt: skip
    return "".join(f"{b},{t:.12f}, {u:.5f},\n" for b, t, u in zip(block + [",,"] * (N - len(block)), T, U, strict=True))


def _lvm(kind: str, decimal: str = ".") -> str:
    head = (
        f"LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t{decimal}\n"
        f"Multi_Headings\tYes\nX_Columns\t{kind}\nTime_Pref\tRelative\nOperator\tme\nDate\t2024/03/04\nTime\t12:00:00\n"
        "***End_of_Header***\t\n\t\n"
    )
    two, doubled = ("Channels\t2\t\t\n", "\t") if kind == "Multi" else ("Channels\t2\t\n", "")
    segment = (
        f"{two}Samples\t{N}\t{doubled}{N}\nDate\t2024/03/04\t{doubled}2024/03/04\nY_Unit_Label\tV\t{doubled}um\n"
        f"X_Dimension\tTime\t{doubled}Time\nX0\t0.0E+0\t{doubled}0.0E+0\nDelta_X\t0.0001\t{doubled}0.0001\n"
        "***End_of_Header***\t\t\n"
    ).replace(".", decimal)
    names = {
        "No": "X_Value\tu\tx\tComment\n",
        "One": "X_Value\tu\tx\tComment\n",
        "Multi": "X_Value\tu\tX_Value\tx\tComment\n",
    }
    if kind == "No":
        body = rows([""] * N, U, X, sep="\t", decimal=decimal)
    else:
        body = rows(*((T, U, X) if kind == "One" else (T, U, T, X)), sep="\t", decimal=decimal)
    return head + segment + names[kind] + body


def _varied_units() -> list[str]:
    return [f"{1e3 * u:.1f} mV" if abs(u) < 1 else f"{u:.4f} V" for u in U]


UX = {"u": ("V", U), "x": ("um", X)}
BARE = {"u": (None, U), "x": (None, X)}
LVM = {"u": ("V", U), "x": ("um", X)}
MANUAL, SEEN, PROJECT = (
    "the program's manual",
    "files of the program in public repositories",
    "the format's description",
)
CASES = "reduced from laboratories' files"

LAYOUTS: list[Layout] = [
    # oscilloscopes
    text("Tektronix TDS2000", "settings beside the first rows", MANUAL, _side_block(), {"CH1": ("V", U)}),
    text(
        "Tektronix MSO5",
        "settings above, a row of labels",
        MANUAL,
        "Model,MSO54\nFirmware Version,1.10\n\nWaveform Type,ANALOG\nPoint Format,Y\nHorizontal Units,s\n"
        "Horizontal Scale,0.001\nSample Interval,1.0E-4\nRecord Length,60\nGating,0.0% to 100.0%\nProbe Attenuation,1\n"
        "Vertical Units,V\nVertical Offset,0\nVertical Scale,1\nLabel,\nTIME,CH1\n" + rows(T, U),
        {"CH1": ("V", U)},
    ),
    text(
        "Keysight InfiniiVision",
        "numbers as names, a row of units",
        MANUAL,
        "x-axis,1,2\nsecond,Volt,Volt\n" + rows(T - 0.006, U, X),
        {"1": ("Volt", U), "2": ("Volt", X)},
    ),
    text(
        "Keysight Infiniium",
        "settings with colons, values alone",
        MANUAL,
        "Revision:,0\nType:,raw\nStart:,0\nPoints:,60\nCount:,1\nXDispRange:,1e-3\nXInc:,1.0E-4\nXOrg:,-3.0E-3\n"
        "YUnits:,Volt\nData:,\n" + rows(U),
        {"column_1": ("Volt", U)},
    ),
    text(
        "Rigol DS1000Z",
        "Start and Increment behind the names",
        MANUAL,
        "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-6.0e-03,1.0e-04,\n" + rows(COUNT, U, X, end=",\n"),
        {"CH1": ("Volt", U), "CH2": ("Volt", X)},
    ),
    text(
        "Rigol DS1000E",
        "Start and Increment, one channel",
        MANUAL,
        "X,CH1,Start,Increment\nSequence,Volt,-6.0e-03,1.0e-04\n" + rows(COUNT, U, end=",\n"),
        {"CH1": ("Volt", U)},
    ),
    text(
        "Siglent SDS",
        "settings of each channel, Source, Second",
        MANUAL,
        "Record Length,Analog:60\nSample Interval,Analog:0.000100000\nVertical Units,CH1:V,CH2:V\n"
        "Vertical Scale,CH1:2.00,CH2:2.00\nVertical Offset,CH1:0.0,CH2:0.0\nHorizontal Units,s\n"
        "Horizontal Scale,0.001\nModel Number,SDS1104X\nSerial Number,SDS1\nSource,CH1,CH2\nSecond,Volt,Volt\n"
        + rows(T, U, X),
        {"CH1": ("Volt", U), "CH2": ("Volt", X)},
    ),
    text(
        "LeCroy WaveSurfer",
        "segments above",
        MANUAL,
        "LECROYWS424,12345,Waveform\nSegments,1,SegmentSize,60\nSegment,TrigTime,TimeSinceSegment1\n"
        "#1,04-Mar-2024 12:00:00,0\nTime,Ampl\n" + rows(T, U),
        {"Ampl": (None, U)},
    ),
    text(
        "Rohde & Schwarz RTB",
        "units after in",
        MANUAL,
        "in s,CH1 in V,CH2 in V\n" + rows(T, U, X, fmt="%.6E"),
        {"CH1 in V": ("V", U), "CH2 in V": ("V", X)},
    ),
    text(
        "PicoScope",
        "a row of units in brackets, ∞",
        MANUAL,
        "Time,Channel A,Channel B\n(ms),(V),(mV)\n\n" + rows(1e3 * T, U, _marked("∞")),
        {"Channel A": ("V", U), "Channel B": ("mV", X_OVER)},
    ),
    text(
        "PicoScope, German",
        "the same with decimal commas",
        MANUAL,
        "Zeit;Kanal A;Kanal B\n(ms);(V);(mV)\n\n" + rows(1e3 * T, U, X, sep=";", decimal=","),
        {"Kanal A": ("V", U), "Kanal B": ("mV", X)},
    ),
    text(
        "Yokogawa DL850",
        "a settings block with TraceName and VUnit",
        MANUAL,
        '"TraceName","CH1","CH2"\n"BlockNumber",1\n"BlockSize",60\n"VUnit","V","V"\n"SampleRate",10000\n"HResolution",1.0E-04\n'
        '"HOffset",0.0\n"HUnit","s"\n"Date","2024/03/04"\n"Time","12:00:00"\n\n' + rows([""] * N, U, X, sep=","),
        {"CH1": ("V", U), "CH2": ("V", X)},
    ),
    text(
        "Digilent WaveForms",
        "comments with the rate",
        MANUAL,
        "#Digilent WaveForms Oscilloscope Acquisition\n#Device Name: Discovery2\n#Serial Number: SN:210321\n"
        "#Date Time: 2024-03-04 12:00:00\n#Sample rate: 10000Hz\n#Samples: 60\n#Trigger: Source: None\n\n"
        "Time (s),Channel 1 (V),Channel 2 (V)\n" + rows(T, U, X),
        {"Channel 1 (V)": ("V", U), "Channel 2 (V)": ("V", X)},
    ),
    text(
        "Saleae Logic",
        "Time [s] and channels",
        MANUAL,
        "Time [s],Channel 0,Channel 1\n" + rows([f"{t:.9f}" for t in T], U, X),
        {"Channel 0": (None, U), "Channel 1": (None, X)},
    ),
    text(
        "Liquid Instruments Moku",
        "names in the last comment",
        MANUAL,
        "% Moku:Go Data Logger\n% Acquisition rate: 1.0000000000e+04 Hz, Mode: Normal\n"
        "% Acquired 2024-03-04 T 12:00:00 +0000\n"
        "% Time (s), Channel A (V), Channel B (V)\n" + rows(T, U, X, fmt="%.10e"),
        {"Channel A (V)": ("V", U), "Channel B (V)": ("V", X)},
    ),
    text(
        "Red Pitaya",
        "channels alone",
        MANUAL,
        "CH1 [V],CH2 [V]\n" + rows(U, X),
        {"CH1 [V]": ("V", U), "CH2 [V]": ("V", X)},
        None,
    ),
    # sensors, controllers, loggers
    text(
        "Keyence LK-Navigator",
        "dashes while there is no reading",
        CASES,
        "No.,OUT1 (mm),OUT2 (V)\n" + rows(COUNT, _marked("-------"), U),
        {"OUT1 (mm)": ("mm", X_OVER), "OUT2 (V)": ("V", U)},
        None,
    ),
    text(
        "Keyence LK-G",
        "-FFFFFFF for out of range",
        MANUAL,
        HEAD + rows(T, U, _marked("-FFFFFFF")),
        {"u [V]": ("V", U), "x [um]": ("um", X_OVER)},
    ),
    text(
        "Physik Instrumente",
        "GCS array, blanks",
        MANUAL,
        "# REM piezo controller\n#\n# VERSION = 1\n# TYPE = 1\n# SEPARATOR = 32\n# DIM = 2\n"
        "# SAMPLE_TIME = 100.000000e-6\n"
        "# NDATA = 60\n#\n# NAME0 = Control Voltage of Output Chan 1\n"
        "# NAME1 = Current Position of axis 1\n#\n# END_HEADER\n" + rows(U, X, sep=" "),
        {"Control Voltage of Output Chan 1": (None, U), "Current Position of axis 1": (None, X)},
    ),
    text(
        "Physik Instrumente",
        "GCS array, tabs, names from 1",
        MANUAL,
        "# TYPE = 1\n# SEPARATOR = 9\n# DIM = 2\n# SAMPLE_TIME = 0.000100\n# NDATA = 60\n"
        "# NAME1 = Target\n# NAME2 = Actual\n"
        "# END_HEADER\n" + rows(U, X, sep="\t"),
        {"Target": (None, U), "Actual": (None, X)},
    ),
    text(
        "Micro-Epsilon sensorTOOL",
        "decimal comma, semicolons",
        MANUAL,
        "Zeit [s];Abstand 1 [mm]\n" + rows(T, X, sep=";", decimal=","),
        {"Abstand 1 [mm]": ("mm", X)},
    ),
    text(
        "Polytec",
        "a row of units with blanks in the brackets",
        MANUAL,
        "Time\tVelocity\n[ s ]\t[ m/s ]\n" + rows(T, U, sep="\t"),
        {"Velocity": ("m/s", U)},
    ),
    text(
        "Zurich Instruments LabOne",
        "ticks of a stated clockbase",
        MANUAL,
        "# clockbase: 60000000\nchunk;timestamp;value\n"
        + rows(["0"] * N, _whole(1_234_567_890_123 + 6000 * np.arange(N)), U, sep=";"),
        {"value": (None, U)},
    ),
    text(
        "SCPI instrument",
        "9.91E37 and 9.9E37",
        "SCPI 1999, volume 1, 7.2.1.4",
        HEAD + rows(T, U, [{7: "9.91E37", 8: "9.9E37", 40: "-9.9E+37"}.get(k, f"{x:.4f}") for k, x in enumerate(X)]),
        {"u [V]": ("V", U), "x [um]": ("um", X_OVER)},
    ),
    text(
        "Keithley 2000",
        "OVERFLOW in place of a reading",
        SEEN,
        HEAD + rows(T, U, _marked("OVERFLOW")),
        {"u [V]": ("V", U), "x [um]": ("um", X_OVER)},
    ),
    text(
        "Keysight BenchLink",
        "month first, ms behind a colon, VDC",
        MANUAL,
        "Scan,Time,101 (VDC),102 (VDC)\n"
        + rows(_whole(range(1, N + 1)), [f"03/04/2024 12:00:{k // 10:02d}:{k % 10}00" for k in range(N)], U, X),
        {"101 (VDC)": ("VDC", U), "102 (VDC)": ("VDC", X)},
        10.0,
    ),
    text(
        "HBM catman",
        "channel names with their rate",
        MANUAL,
        "HBM_CATMAN_DATAFILE_40\n\nTime  1 - default sample rate [s]\tDrive [V]\tPos [µm]\n" + rows(T, U, X, sep="\t"),
        {"Drive [V]": ("V", U), "Pos [µm]": ("µm", X)},
    ),
    text(
        "imc FAMOS",
        "names, then units",
        MANUAL,
        "Zeit\tKanal1\tKanal2\ns\tV\tµm\n" + rows(T, U, X, sep="\t", decimal=","),
        {"Kanal1": ("V", U), "Kanal2": ("µm", X)},
        encoding="cp1252",
    ),
    text(
        "DEWESoft",
        "names with units",
        MANUAL,
        "Time (s);AI 1 (V);AI 2 (µm)\n" + rows(T, U, X, sep=";"),
        {"AI 1 (V)": ("V", U), "AI 2 (µm)": ("µm", X)},
    ),
    text(
        "Origin",
        "long names, units, comments",
        MANUAL,
        "Time\tDrive\tPosition\ns\tV\tµm\n\tfirst run\tfirst run\n" + rows(T, U, X, sep="\t"),
        {"Drive": ("V", U), "Position": ("µm", X)},
    ),
    text(
        "dSPACE-like logger",
        "quantity / unit",
        "ISO 80000-1",
        "t/s;U/V;x/µm\n" + rows(T, U, X, sep=";"),
        {"U/V": ("V", U), "x/µm": ("µm", X)},
    ),
    # LabVIEW
    text("LabVIEW LVM", "X_Columns One", MANUAL, _lvm("One"), LVM),
    text("LabVIEW LVM", "X_Columns No: X0 and Delta_X", MANUAL, _lvm("No"), LVM),
    text("LabVIEW LVM", "X_Columns Multi, one clock", MANUAL, _lvm("Multi"), LVM),
    text("LabVIEW LVM", "decimal commas", MANUAL, _lvm("One", ","), LVM),
    # spreadsheets, scripts, databases
    text(
        "Excel, German",
        "semicolons, decimal commas, a mark of UTF-8",
        SEEN,
        "Zeit [s];u [V];x [um]\r\n" + rows(T, U, X, sep=";", decimal=",", end="\r\n"),
        encoding="utf-8-sig",
    ),
    text(
        "Excel",
        "line breaks in the cells of names",
        CASES,
        '"Time\n[s]","Drive\n[V]","Position\n[um]"\n' + BODY,
        {"Drive [V]": ("V", U), "Position [um]": ("um", X)},
    ),
    text(
        "Excel",
        "empty cells behind and below the table",
        CASES,
        "Time [s],u [V],x [um],,,\n" + rows(T, U, X, end=",,,\n") + ",,,,,\n,,,,,\n",
    ),
    text(
        "Excel",
        "thousands",
        SEEN,
        "Time [s];u [V];x [um]\n"
        + rows(T, [f"1 {234.5 + u:.3f}" for u in U], [f"1'{600.25 + x:.4f}" for x in X], sep=";"),
        {"u [V]": ("V", 1234.5 + np.round(U, 3)), "x [um]": ("um", 1600.25 + X)},
    ),
    text("Word processor", "a typographic minus", SEEN, HEAD + BODY.replace("-", "−")),
    text(
        "Excel",
        "quoted decimal commas between commas",
        SEEN,
        "Time [s],u [V],x [um]\n"
        + rows(
            [f'"{t:.4f}"'.replace(".", ",") for t in T],
            [f'"{u:.4f}"'.replace(".", ",") for u in U],
            [f'"{x:.4f}"'.replace(".", ",") for x in X],
        ),
    ),
    text("MATLAB writetable", "names of variables", MANUAL, "t,u,x\n" + BODY, BARE),
    text(
        "MATLAB timetable",
        "durations with their unit",
        MANUAL,
        "Time,u,x\n" + rows([f"{t:.4f} sec" for t in T], U, X),
        BARE,
    ),
    text(
        "MATLAB",
        "NaN and Inf",
        MANUAL,
        HEAD + rows(T, U, _marked("NaN")),
        {"u [V]": ("V", U), "x [um]": ("um", X_OVER)},
    ),
    text("pandas", "an index without a name", "pandas.DataFrame.to_csv", ",time_s,u,x\n" + rows(COUNT, T, U, X), BARE),
    text("pandas", "an index of dates", "pandas.DataFrame.to_csv", ",u,x\n" + rows(ISO, U, X), BARE),
    text(
        "R write.table",
        "a name less than columns",
        "R documentation of write.table",
        '"t" "u" "x"\n' + rows([f'"{k + 1}"' for k in range(N)], T, U, X, sep=" "),
        BARE,
    ),
    text(
        "numpy savetxt", "names in a comment", "numpy.savetxt", "# t u x\n" + rows(T, U, X, sep=" ", fmt="%.18e"), BARE
    ),
    text("gnuplot", "units behind names, blanks", SEEN, "# Time [s]   u [V]   x [um]\n" + rows(T, U, X, sep="   ")),
    text(
        "LTspice",
        "tabs",
        MANUAL,
        "time\tV(out)\tI(R1)\n" + rows(T, U, X, sep="\t", fmt="%.15e"),
        {"V(out)": (None, U), "I(R1)": (None, X)},
    ),
    text("Fortran", "exponents with D", SEEN, "t u x\n" + rows(T, U, X, sep="  ", fmt="%.6E").replace("E", "D"), BARE),
    text(
        "InfluxDB",
        "ns since 1970 behind a name",
        MANUAL,
        "name,time,u,x\n" + rows(["m"] * N, _whole([1_700_000_000_000_000_000 + 100_000 * k for k in range(N)]), U, X),
        BARE,
    ),
    text(
        "JavaScript",
        "ms since 1970",
        CASES,
        "timestamp,u,x\n" + rows(_whole(1_700_000_000_000 + np.arange(N)), U, X),
        BARE,
        1000.0,
    ),
    text(
        "PlotJuggler",
        "s since 1970 with fractions",
        SEEN,
        "__time,u,x\n" + rows([f"1700000000.{k:06d}" for k in range(0, 100 * N, 100)], U, X),
        BARE,
    ),
    text(
        "rosbag to CSV",
        "%time in ns",
        SEEN,
        "%time,field.u,field.x\n" + rows([str(1_700_000_000_000_000_000 + 100_000 * k) for k in range(N)], U, X),
        {"field.u": (None, U), "field.x": (None, X)},
    ),
    text(
        "rostopic",
        "seconds and nanoseconds apart",
        SEEN,
        "header.stamp.secs,header.stamp.nsecs,u,x\n" + rows(["1700000000"] * N, _whole(100_000 * np.arange(N)), U, X),
        BARE,
    ),
    text("Grafana", "dates", SEEN, '"Time","u","x"\n' + rows(ISO, U, X), BARE),
    text(
        "a logger",
        "day, month, year",
        SEEN,
        "Datum;u;x\n" + rows([f"04.03.2024 12:00:00,{k:04d}" for k in range(N)], U, X, sep=";", decimal=","),
        BARE,
    ),
    text(
        "a logger",
        "time of day over midnight",
        SEEN,
        "Time,u,x\n"
        + rows([f"23:59:59.{9950 + k:04d}" if k < 50 else f"00:00:00.{k - 50:04d}" for k in range(N)], U, X),
        BARE,
    ),
    text("a logger", "date and time apart", SEEN, "Date,Time,u,x\n" + rows(["2024-03-04"] * N, CLOCK, U, X), BARE),
    text(
        "a logger",
        "units behind each value, which change",
        CASES,
        "Time,u\n" + rows([f"{1e3 * t:.1f} ms" for t in T], _varied_units()),
        {"u": ("mV", 1e3 * U)},
    ),
    text(
        "a spectrometer's macro",
        "a row of ones between names and numbers",
        CASES,
        "Time [s],u [V],x [um]\nscale,1.0,1.0\n" + BODY,
    ),
    text("a macro", "a date above the names, empty names", CASES, "Date,2024-03-04\nTime [s],u [V],x [um],,,\n" + BODY),
    text(
        "a macro",
        "a vertical tab and a line separator in a line",
        CASES,
        "made by\x0ba macro\u2028of ours\n" + HEAD + BODY,
    ),
    text("Windows", "UTF-16 without a mark", SEEN, HEAD + BODY, encoding="utf-16-le"),
    text("Windows", "UTF-16, big end first", SEEN, "\ufeff" + HEAD + BODY, encoding="utf-16-be"),
    text("gzip", "packed", "RFC 1952", HEAD + BODY, pack=lambda data: gzip.compress(data, mtime=0)),
    text("old Macintosh", "lines that end with CR", SEEN, (HEAD + BODY).replace("\n", "\r")),
    text("a logger", "a footer", SEEN, HEAD + BODY + "\nEnd of measurement\n60 samples written\n"),
    text(
        "a logger",
        "a clock rounded to 1 µs at 25.6 kHz",
        CASES,
        HEAD + rows([f"{k / 25600:.6f}" for k in range(N)], U, X),
        None,
        25_600.0,
    ),
    text("a logger", "the rate above the table", SEEN, "Fs = 10 kHz\nu [V],x [um]\n" + rows(U, X)),
    text("a logger", "the period above the table", SEEN, "# dt [ms]: 0.1\nu [V]\tx [um]\n" + rows(U, X, sep="\t")),
    text(
        "a logger",
        "a time without a unit, and the period",
        SEEN,
        "dt;0.1 ms\nTime;u;x\n" + rows(1e3 * T, U, X, sep=";"),
        BARE,
    ),
    text("a logger", "a rate with thousands", SEEN, "Sampling Rate: 10,000 Hz\n" + "u [V],x [um]\n" + rows(U, X)),
    text("a logger", "the unit of a rate in the next cell", SEEN, "Sample Rate,10.0,kHz\nu [V],x [um]\n" + rows(U, X)),
    text(
        "a logger",
        "units behind values below another unit",
        SEEN,
        "Time [s],u [V]\n" + rows(T, [f"{1e3 * u:.1f} mV" for u in U]),
        {"u [V]": ("V", U)},
    ),
    text("a logger", "the same times twice", SEEN, "Time [s],u [V],Time [s],x [um]\n" + rows(T, U, T, X)),
]


class Question(NamedTuple):
    """A file with several readings; `options` each decides for one, as the question must say."""

    ambiguity: str
    content: bytes
    options: Sequence[str]
    name: str = "scan.csv"


def question(ambiguity: str, content: str, *options: str) -> Question:
    """Return a question about a text file."""
    return Question(ambiguity, content.encode(), options)


PLAIN = "Time [s],u [V],x [um]\n"
SLOW = np.arange(N) * 0.1
LONG = np.linspace(1.0, 9.0, N)

QUESTIONS: list[Question] = [
    question("the first column has no name and grows", rows(T, U, X), "--clock column_1 --time-unit s", "--rate HZ"),
    question(
        "a comma between whole numbers, no names",
        "".join(f"{k % 7},{k % 9}\n" for k in range(N)),
        "--delimiter ,",
        "--decimal ,",
    ),
    question(
        "four fields for two names",
        "t,u\n" + rows(T, U + 3).replace(".", ","),
        "--delimiter , --decimal .",
        "--delimiter , --decimal ,",
    ),
    question(
        "thousands or decimals",
        "t;u\n" + "".join(f"{k + 1},{k:03d};{k + 2},{k:03d}\n" for k in range(N)),
        "--decimal .",
        "--decimal ,",
    ),
    question(
        "thousands or decimals, by points",
        "a;b\n" + "".join(f"{k + 1}.{k:03d};{k + 2}.{k:03d}\n" for k in range(N)),
        "--decimal .",
        "--decimal ,",
    ),
    question("whole times without a unit", "Time,u,x\n" + rows(COUNT, U, X), "--time-unit s", "--time-unit ms"),
    question(
        "whole times in steps of 10", "t,u\n" + rows(_whole(10 * np.arange(N)), U), "--time-unit ms", "--time-unit µs"
    ),
    question("times of 0.1 without a unit", "t,u\n" + rows(SLOW, U), "--time-unit s", "--time-unit ms"),
    question("a name less than columns", "u [V],x [um]\n" + BODY, "--header-row 1", "--header-row 0"),
    question("a name more than columns", "a,b,c,d\n" + BODY, "--header-row 1", "--header-row 0"),
    question("two names for four columns", "u,x\n" + rows(T, U, X, U), "--header-row 1", "--skip-rows 1"),
    question(
        "a scale between names and numbers",
        PLAIN + "scale,2.0,1.0\n" + BODY,
        "--skip-rows 2",
        '--skip-rows 2 --map "SIGNAL=u * 2"',
    ),
    question(
        "an offset between names and numbers",
        PLAIN + "offset,0.0,10.0\n" + BODY,
        "--skip-rows 2",
        '--skip-rows 2 --map "SIGNAL=x + 10"',
    ),
    question(
        "codes below a factor",
        "YMULT,4.0E-3\nTime [s],CH1\n" + rows(T, _whole(np.rint(100 * U))),
        "--skip-rows 1",
        '--skip-rows 1 --map "SIGNAL=CH1 * 0.004"',
    ),
    question(
        "volts a code above whole numbers",
        "# Volts per LSB: 0.000305\nTime [s],ADC\n" + rows(T, _whole(np.rint(1000 * U))),
        "--skip-rows 1",
        '--skip-rows 1 --map "SIGNAL=ADC * 0.000305"',
    ),
    question(
        "the times contradict the rate", "Sample rate,20000\n" + PLAIN + BODY, "--clock 'Time [s]'", "--clock stated"
    ),
    question("the times contradict the period", "# dt = 1 ms\n# t,u\n" + rows(T, U), "--clock 't'", "--clock stated"),
    question("two rates", "Sample rate,20000\ndt,1e-4\nu [V],x [um]\n" + rows(U, X), "--rate 20000", "--rate 10000"),
    question(
        "two clocks beside each other",
        "Time [s],Elapsed [ms],u\n" + rows(T, 1e3 * (T * 1.01 + 0.5), U),
        "--clock 'Time [s]'",
        "--clock 'Elapsed [ms]'",
    ),
    question(
        "-9999 far from all other values",
        PLAIN + rows(T, U, ["-9999" if k in OVER else f"{x:.4f}" for k, x in enumerate(X)]),
        "--missing -9999",
        "--missing none",
    ),
    question(
        "32767 far from all other values",
        PLAIN + rows(T, ["32767" if k == 3 else f"{u:.4f}" for k, u in enumerate(U)], X),
        "--missing 32767",
        "--missing none",
    ),
    question(
        "999.99 at the end of a range",
        PLAIN + rows(T, U, ["999.99" if k in OVER else f"{x:.4f}" for k, x in enumerate(X)]),
        "--missing 999.99",
        "--missing none",
    ),
    question("a unit in the name, another below", "Time [s],u [V]\ns,mV\n" + rows(T, U), 'u [V]"', 'u [mV]"'),
    question(
        "an unknown word among the numbers", PLAIN + rows(T, U, _marked("SAT")), "--missing 'SAT'", "--skip-rows 9"
    ),
    question("a mean below the numbers", PLAIN + BODY + "Mean,0.1,0.2\n", "--missing 'Mean'", f"--skip-rows {N + 2}"),
    question(
        "ten rows for each stamp", "Time [s],u\n" + rows([f"{t:.3f}" for t in T], U), "--rate 9833.33", "--time COLUMN"
    ),
    question("numbers as names", "Time,1,2\n" + rows(T, U, X), "--header-row 1", "--skip-rows 1"),
    question(
        "day or month",
        "Date,u\n" + rows([f"0{3 + k // 30}/04/2024 12:00:{k % 30:02d}.0" for k in range(N)], U),
        "--dates day",
        "--dates month",
    ),
    question(
        "two rows of names",
        "Name,ch1,ch2\nData-Type,REAL64,REAL32\n" + rows(U, U, X),
        "--header-row 1",
        "--header-row 2",
    ),
    question(
        "days of a spreadsheet",
        "Time,u\n" + rows([f"{45355.5 + k / 864000:.9f}" for k in range(N)], U),
        "--time-unit d",
        "--rate HZ",
    ),
    question(
        "one column, thousands or decimals",
        "u [V]\n" + "".join(f"{k + 1},{k:03d}\n" for k in range(N)),
        "--decimal ,",
        "--decimal .",
    ),
    question(
        "a decimal sign that only one half shows",
        "t;u\n" + "".join(f"{k};{k % 9 + 1}.{k:03d}\n" for k in range(N)),
        "--decimal .",
        "--decimal ,",
    ),
]
