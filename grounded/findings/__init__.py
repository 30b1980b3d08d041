"""Findings: everything that a command tells, as data; the words stand in one catalogue.

    finding     Finding, Weight, Quantity: a code, what it is about, and facts with units;
                settle: what hides what, what is told once, what refuses
    numbers     formats the facts in a sentence: units, lists, +-, plurals
    catalogue   code -> weight, sentence, remedy

Read `finding`, then one area of the catalogue. Code reads codes and facts. No code reads, compares
or cuts a sentence.
"""

from grounded.findings.finding import Finding as Finding
from grounded.findings.finding import Quantity as Quantity
from grounded.findings.finding import Weight as Weight
from grounded.findings.finding import found as found
from grounded.findings.finding import settle as settle
