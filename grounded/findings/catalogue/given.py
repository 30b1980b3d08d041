"""Findings on what a user gives: values, names, shapes, and things that do not fit together."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    "value": Entry(
        "refuse",
        "{about} must be[[ {must:given=given,real=one real number,named=read by name,"
        "level=those of a level flight,inside=inside the "
        "workspace,even=equally long,groups=two groups of different trials,"
        "plant=a dict input -> seconds and a whole number,words=a "
        "program with the words for both files,number=a number,units=names with a unit each,"
        "free=another name: grounded writes this one,outside=outside the folder of the cases,"
        "unique=one file: give more digits of its hash,finite=finite,positive=a positive number,"
        "whole=a whole number,numbers=an array of numbers,names=a list of names,above=above 0,"
        "str=a text,float=a number,int=a whole number,list=a list in brackets,natural=0 or more,"
        "nonzero=other than 0,pair=[low; high],time=a time of a log's clock,path=a message path,"
        "crossing=a time or a path with one of above and below,one=either a file or a module,"
        "alone=without a model,effects=tables with a name,deviations=standard deviations of "
        "states,divisor=a whole part of the control step,way=away from the start,span=at some time "
        "in the log,actuator=a file "
        "of one actuator,"
        "weights=finite and not negative,place=one state along an axis, two in a plane "
        "(horizontal first) or three,bool=True or False,dict=a dict by name,ascending=in "
        "ascending order,name=a valid Python name,trial=the gr.Trial of the run,"
        "call=a function of a candidate that returns the Trial of its run,"
        "bounded=inside its bounds:}]][[ of the form {form}]][[ a {type}]]"
        "[[ of shape {shape}]][[ from "
        "{low}]][[ to {high}]][[ below {below}]][[: {known}]][[, such as {like}]][[, not "
        "{given}]][[: did you mean '{near}'?]]",
        "[[{do:omit=omit the column if the state is free,turned=transpose it,column=make it a "
        "column, inputs[:, None],last=leave out the last row, since the last state has no input,"
        "rows=give one row for each control step and one for the end,free=infinite for no limit,"
        "widen=correct it, or widen the bounds of its Param,"
        "read=`grounded_trials.store.trial_file.read_trial` reads a file,load=read a file with "
        "`load(path)`,hold=hold a value inside ([task] start; in Python past), or widen the "
        "limits}]]",
    ),
    "name": Entry(
        "refuse",
        "[[{of} has]][[!of? there is]] no {kind} '{about}'[[: did you mean '{near}'?]][[: there "
        "are {known}]]",
    ),
    "twice": Entry("refuse", "'{name}' stands twice in {about}[[, as {kinds}]]", "change one"),
    "either": Entry(
        "refuse",
        "{about}: expected {how:one=exactly one of them,both=both or none,first=the second only "
        "with the first}",
    ),
    "fit": Entry(
        "refuse", "{about} has the {what} {theirs}, expected {own}[[ in this order{order:1=}]]"
    ),
    "large": Entry(
        "refuse",
        "{about} has {states} states and {inputs} inputs, more than the {most} for which a "
        "{what:plan=plan,fit=fit,diagnosis=diagnosis} is made",
    ),
    "short": Entry(
        "refuse",
        "a {what:bias=bias,fit=fit,noise=noise estimate,estimate=state estimate,"
        "diagnosis=diagnosis} needs a trial of {needs} finite steps or more[[, got {has}]]",
    ),
    "unweighed": Entry(
        "refuse",
        "[reward] weighs {about}, but the target has no value for it[[ at step {step}]]",
        "add the column to the target ([[`{to}`]][[!to? for a line: `--to {about}=0`]]; if only "
        "`terminal` weighs it,"
        " only the last value counts), or drop the weight",
    ),
    "no_input": Entry(
        "refuse",
        "{about} has no {what}",
        "[[{what:state=,input=for a free motion, add the force that nobody applied, and to the "
        "log a column of zeros}]]",
    ),
    "constant": Entry(
        "refuse",
        "{about} has no uncertain parameter[[ '{name}']] to fit",
        "give bounds, Param(value, unit, low, high), or a prior, Param(value, unit, std=s)",
    ),
}
